"""Generated plans by family and seed, and the named suites with fixed seeds.

Training, validation and test draw from disjoint ranges of seeds: training from 0 to 10^9 - 1,
validation from 10^9, test from 2 * 10^9. A suite's content hash depends on every plan's geometry.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np

from polyexplore_gym.errors import InvalidFloorPlanError
from polyexplore_gym.floorplan.angled import draw_angled
from polyexplore_gym.floorplan.homes import draw_home
from polyexplore_gym.floorplan.model import FloorPlan
from polyexplore_gym.floorplan.offices import draw_office

FAMILIES = ("home", "office", "angled")
"""The families of generated plans."""
TRAIN_SEEDS = range(0, 10**9)
"""Seeds for training."""
VALIDATION_SEEDS = range(10**9, 2 * 10**9)
"""Seeds for choosing between models and settings."""
TEST_SEEDS = range(2 * 10**9, 3 * 10**9)
"""Seeds for final results."""
_DRAW = {"home": draw_home, "office": draw_office, "angled": draw_angled}
_SPLITS = {"train": (TRAIN_SEEDS, 1000), "validation": (VALIDATION_SEEDS, 30), "test": (TEST_SEEDS, 50)}
# Mixed suites take the first plans of the families' suites, in turn.
_MIXED_SIZES = {"train": 333, "validation": 10, "test": 17}
_ATTEMPTS = 100
CONTENT_HASHES = {
    "angled-test": "6f18f38bb0010f6f6d50617bbf70cf12147ec9191f659ee9e0b7a9bb76b48b08",
    "angled-train": "40c1700c6f735260c6e2cf74672759b11690f7aee927722d8ae9443edeb8a477",
    "angled-validation": "cbbce6550a65552b71d90da54cd94f12fb7b1b50ff7e9b06123342f93cc3b8c2",
    "home-test": "3e8cfb5603ce64b797219aa7a4f93094708d355960e9ecc9359b9259395fb304",
    "home-train": "a7566b865f3d9c4c28357133bca3f50d4980c67df13e729fe1e4df08ceef3825",
    "home-validation": "2103975bf053eaa464a0e92e2729bf4f19ff6ba482c73847853e4097a188e734",
    "mixed-test": "af919d7db73c3e39dbaf9fbf1c6a3419e975ea87a5b411a409d06ee3b759a2a7",
    "mixed-train": "90ffc347eca8b15f183d7e97826bab88ad0a77f46bc837208d7a5bc67e85d852",
    "mixed-validation": "7d4977b957dc07b8cb5401e10fb3552008552fcb7f923a7eb515e7bcb28a1822",
    "office-test": "8f16936e564ef20765f2c3c5c40359b1699e1a45dcc0d0e9c7e8fcc10dbc2e72",
    "office-train": "a9787fec32222d7e585b91e7b76c70765f09738932821a1be47150209e468d8f",
    "office-validation": "dd1e2c887a614689003e52d34e213836c119daefa6ac4ee0847b032aa4558419",
}
"""The suites' content hashes; results under other hashes are not comparable. A test compares them."""


@lru_cache(maxsize=128, typed=True)
def generate(family: str, seed: int) -> FloorPlan:
    """The plan of a family ("home", "office" or "angled") for a seed, always the same one.

    It is connected for a disc of 0.30 m radius.

    Raises:
        ValueError: unknown family or negative seed.
    """
    if family not in FAMILIES:
        raise ValueError(f"unknown family {family!r}; known: {', '.join(FAMILIES)}")
    if isinstance(seed, bool) or not isinstance(seed, (int, np.integer)) or seed < 0:
        raise ValueError(f"seed {seed!r}: must be an integer, not negative")
    meta = {"family": family, "seed": int(seed)}
    for attempt in range(_ATTEMPTS):
        rng = np.random.default_rng([FAMILIES.index(family), int(seed), attempt])
        plan = _DRAW[family](rng, f"{family}-{seed}", meta)
        if plan is not None:
            return plan
    raise InvalidFloorPlanError(f"{family}-{seed}: no plan in {_ATTEMPTS} attempts")


@dataclass(frozen=True)
class Suite:
    """A named list of generated plans, drawn when asked for."""

    name: str
    """Family and split, as in "home-test"."""
    plan_ids: tuple[str, ...]
    """Family and seed of each plan, as in "home-2000000003"; also the plans' names."""

    def __len__(self) -> int:
        return len(self.plan_ids)

    def plan(self, i: int) -> FloorPlan:
        """The plan with index i.

        Raises:
            IndexError: there is none.
        """
        family, seed = self.plan_ids[i].rsplit("-", 1)
        return generate(family, int(seed))

    def plans(self) -> Iterator[FloorPlan]:
        """All plans in order, one at a time."""
        return (self.plan(i) for i in range(len(self)))

    @cached_property
    def content_hash(self) -> str:
        """sha256 over the plans' content hashes; draws every plan once."""
        digest = hashlib.sha256()
        for plan in self.plans():
            digest.update(bytes.fromhex(plan.content_hash))
        return digest.hexdigest()


def list_suites() -> tuple[str, ...]:
    """Names of all suites."""
    return tuple(f"{family}-{split}" for family in (*FAMILIES, "mixed") for split in _SPLITS)


def suite(name: str) -> Suite:
    """A suite by name.

    Raises:
        ValueError: unknown name.
    """
    if name not in list_suites():
        raise ValueError(f"unknown suite {name!r}; known: {', '.join(list_suites())}")
    family, split = name.split("-")
    seeds, size = _SPLITS[split]
    if family == "mixed":
        ids = [f"{f}-{seeds[i]}" for i in range(_MIXED_SIZES[split]) for f in FAMILIES]
    else:
        ids = [f"{family}-{seeds[i]}" for i in range(size)]
    return Suite(name, tuple(ids))
