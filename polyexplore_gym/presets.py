"""Robots and sensors by name: fields of the configuration, where they differ from the default.

As the makers' data sheets and manuals say. Range noise is one standard deviation; where a sheet gives a
bound it is taken for three of them, and where the noise grows with the range, that at a usual one, named
below. Hardly a sheet says how well the beam angle is known: then it is that of the default, 0.1 degrees.
The body is a disc as wide as the robot.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, Literal

PresetName = Literal[
    "pioneer3dx", "turtlebot3", "turtlebot4", "utm30lx", "realsense_d455", "xtion", "agv_lms111", "sparse_ring"
]

_ALL_ROUND = 2.0 * math.pi

PRESETS: dict[PresetName, Mapping[str, Mapping[str, Any]]] = {
    # SICK LMS 200 in its 8 m mode on a Pioneer 3-DX: the default.
    "pioneer3dx": {},
    # TurtleBot3 Burger with the LDS-01 (ROBOTIS e-manual: precision 3.5 % of the range, taken at 1.75 m; 0.22 m/s,
    # 2.84 rad/s, 1 kg, wheels 0.16 m apart). Radius and accelerations: its navigation package.
    "turtlebot3": {
        "sensor": {"beams": 360, "field_of_view": _ALL_ROUND, "max_range": 3.5, "sigma_range": 0.02},
        "robot": {
            "radius": 0.105, "track": 0.16, "max_speed": 0.22, "max_turn_rate": 2.84, "max_acceleration": 2.5,
            "max_turn_acceleration": 3.2, "mass": 1.0,
        },
    },
    # TurtleBot 4 with the RPLIDAR A1M8 (Slamtec: 12 m, accuracy 2 % of the range at 5 m; user manual: 0.31 m/s with
    # its safety features on, 1.9 rad/s, 3.9 kg, 0.34 m wide; Create 3: wheels 0.233 m apart, 0.9 m/s2 each).
    "turtlebot4": {
        "sensor": {"beams": 360, "field_of_view": _ALL_ROUND, "max_range": 12.0, "sigma_range": 0.03},
        "robot": {
            "radius": 0.17, "track": 0.233, "max_speed": 0.31, "max_turn_rate": 1.9, "max_acceleration": 0.9,
            "max_turn_acceleration": 7.7, "mass": 3.9,
        },
    },
    # Hokuyo UTM-30LX (270 degrees in steps of 0.25, 30 m; standard deviation 10 mm up to 10 m) on the default robot.
    "utm30lx": {
        "sensor": {"beams": 1081, "field_of_view": math.radians(270.0), "max_range": 30.0, "sigma_range": 0.01},
    },
    # Intel RealSense D455, its depth image read as a scan, on the default robot (87 +- 3 degrees wide, up to 6 m, error
    # below 2 % at 4 m, which grows with the square of the range; taken at 3 m). A pixel has 0.1 degrees.
    "realsense_d455": {
        "sensor": {
            "beams": 180, "field_of_view": math.radians(90.0), "max_range": 5.0, "sigma_range": 0.015,
            "sigma_angle": math.radians(0.03),
        },
    },
    # ASUS Xtion PRO or first Kinect, its depth image read as a scan, on the default robot (58 degrees wide, read up to
    # 4 m; noise at 3 m by Khoshelham and Elberink, Sensors 12(2), 2012). A pixel has 0.1 degrees.
    "xtion": {
        "sensor": {
            "beams": 160, "field_of_view": math.radians(58.0), "max_range": 4.0, "sigma_range": 0.013,
            "sigma_angle": math.radians(0.03),
        },
    },
    # SICK LMS111 (270 degrees in steps of 0.5, 20 m; 12 mm, taken as 20 mm and 1 mrad on a vehicle that shakes) on a
    # transporter of 0.58 m width such as the MiR100 (1.5 m/s, 70 kg; wheels, turns and accelerations: its ROS package).
    "agv_lms111": {
        "sensor": {
            "beams": 541, "field_of_view": math.radians(270.0), "max_range": 20.0, "sigma_range": 0.02,
            "sigma_angle": 0.001,
        },
        "robot": {
            "radius": 0.29, "track": 0.445, "max_speed": 1.5, "max_turn_rate": 1.0, "max_acceleration": 1.5,
            "max_turn_acceleration": 2.0, "mass": 70.0,
        },
    },
    # No product: sixty single beams all round, as a turned range finder gives them (Garmin LIDAR-Lite v3: +-25 mm), on
    # a robot as wide as a vacuum cleaner.
    "sparse_ring": {
        "sensor": {"beams": 60, "field_of_view": _ALL_ROUND, "max_range": 8.0, "sigma_range": 0.008},
        "robot": {"radius": 0.2, "track": 0.26, "max_speed": 0.5, "mass": 4.0},
    },
}  # fmt: skip
"""By name; parts of an `EnvConfig` and their fields."""
