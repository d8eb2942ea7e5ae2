"""On a robot: scans and poses in, the next way out, by the policy that was studied in simulation.

    python examples/09_real_robot.py

`explore` is what runs on the robot. The robot here is a stand-in that has the three methods that it needs of yours.
"""

import numpy as np

from baselines import make_policy
from polyexplore_gym.explorer import Explorer


def explore(robot, policy, config):
    explorer, rng = Explorer(config), np.random.default_rng(0)
    for heading in explorer.start_headings(robot.pose()[2]):  # look all round first
        robot.turn(heading)
        explorer.insert(explorer.look(robot.scan(), robot.pose()))  # third, if it is known: the pose's covariance
    explorer.plan()
    while not explorer.done:
        leg = explorer.choose(policy.act(explorer.observation(), explorer.info(), rng))
        while leg is not None:  # drive to the node, with scans on the way
            ended = robot.drive(leg)
            if ended not in ("arrived", "cut"):  # something is in the way
                robot.turn(explorer.stopped(ended, robot.pose()).heading)
            look = explorer.look(robot.scan(), robot.pose())
            leg = explorer.passing(look) if ended == "cut" else explorer.arrived(look)
    return explorer


class StandIn:
    """The simulator's world in the place of a robot's drivers."""

    def __init__(self, config):
        from polyexplore_gym.config import EnvConfig, from_mapping
        from polyexplore_gym.floorplan import generate
        from polyexplore_gym.sim.world import World

        c, plan = from_mapping(EnvConfig, config), generate("home", 3)
        self.rng = np.random.default_rng(1)
        start = plan.sample_start(self.rng, c.robot.radius)
        self.world = World(plan.segments, c.robot, c.sensor, c.drive, start)
        self.pose = lambda: self.world.pose  # yours: of a localiser, or odometry with {"pose": {"mode": "slam"}}
        self.scan = lambda: self.world.measure(self.rng)

    def turn(self, heading):
        self.world.drive(self.world.pose[None, :2], heading)

    def drive(self, leg):
        path = np.vstack((self.world.pose[:2], leg.path[1:]))
        return self.world.drive(path, leg.heading, distance=leg.distance, turn=leg.turn).ended


if __name__ == "__main__":
    config = {"preset": "turtlebot4", "exploration": {"scan_every": 0.5, "decide": "settled"}}
    explorer = explore(StandIn(config), make_policy("nearest"), config)
    print(explorer.outcome()["status"], f"{explorer.scans} scans, {int(explorer.line_map.line_alive.sum())} lines")
