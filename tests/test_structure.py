"""Dependencies point one way, truth never leaks, imports stay light, and randomness is an argument."""

from __future__ import annotations

import ast
import graphlib
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("polyexplore_gym", "baselines")
MODULES = {
    ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__"): path
    for package in PACKAGES
    for path in sorted((ROOT / package).rglob("*.py"))
}
# What a part (a module or folder of the package) may import of this project, beside itself and `errors`.
# evaluation and cli stand above these.
ALLOWED = {
    "errors": set(),
    "presets": set(),
    "config": {"presets"},
    "disc": set(),
    "routes": set(),
    "scan": {"config"},
    "snapshot": set(),
    "rewards": {"config"},
    "optional": set(),
    "robot_map": set(),
    "floorplan": {"config", "optional", "robot_map"},
    "sim": {"config", "disc", "scan"},
    "mapping": {"config", "robot_map"},
    "exploration": {"config", "scan"},
    "observation": {"config", "exploration", "mapping"},
    "outline": {"config", "floorplan", "mapping"},
    "explorer": {"config", "disc", "exploration", "mapping", "observation", "routes", "scan"},
    "wrappers": {"config"},
    "animation": {"optional", "snapshot"},
    "rendering": {"animation", "optional", "snapshot"},
    "env": {
        "config", "exploration", "explorer", "floorplan", "mapping", "observation", "outline", "rendering", "rewards",
        "sim", "snapshot",
    },
}  # fmt: skip
HEAVY = {
    "matplotlib",
    "pygame",
    "torch",
    "cv2",
    "stable_baselines3",
    "sb3_contrib",
    "imageio",
    "PIL",
    "ray",
    "jinja2",
    "minari",
    "h5py",
    "ezdxf",
}
SCRIPTED = (
    "choice", "distance_advantage", "ekman_ratio", "largest", "modified_sum", "nearest", "pockets", "rollout", "tour",
    "tours", "uniform", "utility", "watchman",
)  # fmt: skip
GENERATORS = {"default_rng", "Generator", "SeedSequence", "BitGenerator", "PCG64"}


def part(module: str) -> str:
    """The second part of a dotted name: the noun; "" for the package itself."""
    return (*module.split("."), "")[1]


def resolved(node: ast.ImportFrom, module: str, is_package: bool) -> str:
    if not node.level:
        return node.module or ""
    parts = module.split(".")
    base = parts[: len(parts) - node.level + (1 if is_package else 0)]
    return ".".join([*base, *([node.module] if node.module else [])])


def imports(name: str, tree: ast.AST) -> Iterator[tuple[str, int]]:
    """(dotted name, line) of every import, whether at the top, in a function or under TYPE_CHECKING."""
    is_package = MODULES[name].name == "__init__.py"
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            for alias in node.names:
                yield alias.name, node.lineno
        elif isinstance(node, ast.ImportFrom):
            base = resolved(node, name, is_package)
            for alias in node.names:
                full = f"{base}.{alias.name}"
                yield (full if full in MODULES else base), node.lineno
        elif (
            isinstance(node, ast.Call)
            and ast.unparse(node.func) in ("importlib.import_module", "import_module", "__import__")
            and node.args
            and isinstance(node.args[0], ast.Constant)
        ):
            yield str(node.args[0].value), node.lineno


def top_level(tree: ast.Module) -> Iterator[ast.stmt]:
    """The statements that run on import: not those in functions or under TYPE_CHECKING."""
    todo: list[ast.stmt] = list(tree.body)
    while todo:
        node = todo.pop()
        if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef)):
            continue
        if isinstance(node, ast.If) and ast.unparse(node.test) in ("TYPE_CHECKING", "typing.TYPE_CHECKING"):
            todo += node.orelse
            continue
        yield node
        for name in ("body", "orelse", "finalbody", "handlers"):
            todo += getattr(node, name, [])


TREES = {name: ast.parse(path.read_text(encoding="utf-8"), str(path)) for name, path in MODULES.items()}


def project_imports() -> Iterator[tuple[str, str, str]]:
    """(module, what it imports of this project, where), for every module."""
    for name, tree in TREES.items():
        for imported, line in imports(name, tree):
            if imported.split(".")[0] in (*PACKAGES, "benchmarks", "tests"):
                yield name, imported, f"{name}:{line} imports {imported}"


def test_all_parts_are_found():
    assert set(ALLOWED) < {part(name) for name in MODULES if name.startswith("polyexplore_gym")}
    found = {name.removeprefix("polyexplore_gym.") for name in MODULES}
    assert found >= {
        "sim.world",
        "exploration.map",
        "mapping.line_map",
        "evaluation.runner",
        "cli",
        "baselines.nearest",
    }
    # The reader of imports sees every kind of them.
    text = "from . import a\nfrom ..sim import world\ndef f():\n    import torch\n    from polyexplore_gym import env\n"
    seen = [name for name, _ in imports("polyexplore_gym.exploration.map", ast.parse(text))]
    assert sorted(seen) == ["polyexplore_gym.env", "polyexplore_gym.exploration", "polyexplore_gym.sim.world", "torch"]


def test_dependencies_point_one_way():
    wrong = []
    for name, imported, where in project_imports():
        own, other = part(name), part(imported)
        if name.startswith("polyexplore_gym") and own in ALLOWED:
            ok = imported.startswith("polyexplore_gym.") and other in {own, "errors", *ALLOWED[own]}
        elif own == "evaluation" and name.startswith("polyexplore_gym"):
            ok = other != "cli" and not imported.startswith(("benchmarks", "tests"))
        elif name.startswith("baselines"):
            ok = not imported.startswith(("polyexplore_gym.cli", "benchmarks", "tests"))
        else:  # cli, and the package's __init__
            ok = own == "cli" or not other
        if not ok:
            wrong.append(where)
    assert not wrong


def test_folders_are_entered_by_their_public_names():
    wrong = []
    for name, imported, where in project_imports():
        parts = imported.split(".")
        # Of evaluation and env, the cli and sim's few owners are used by module.
        inner = len(parts) > 2 and parts[1] in ("mapping", "exploration", "floorplan", "outline")
        if inner and part(name) != parts[1] and (part(name), imported) != ("env", "polyexplore_gym.exploration.shapes"):
            wrong.append(where)
    assert not wrong


def test_no_circles():
    graph = {
        name: {
            imported
            for node in top_level(tree)
            if isinstance(node, (ast.Import, ast.ImportFrom))
            for imported, _ in imports(name, node)
            if imported in MODULES
        }
        for name, tree in TREES.items()
    }
    assert len(list(graphlib.TopologicalSorter(graph).static_order())) == len(MODULES)


def test_the_maps_have_no_way_to_the_truth():
    """All that can be reached from mapping and exploration by imports, however far, is free of the truth."""
    graph: dict[str, set[str]] = {name: set() for name in MODULES}
    for name, imported, _ in project_imports():
        graph[name].add(imported)
    own = {"explorer": {"disc", "exploration", "mapping", "observation", "routes"}}
    for start in ("mapping", "exploration", "explorer"):
        todo = [name for name in MODULES if part(name) == start]
        seen = set(todo)
        while todo:
            found = graph[todo.pop()] - seen
            seen |= found
            todo += found
        allowed = {start, "config", "errors", "presets", "robot_map", "scan"} | own.get(start, set())
        assert {part(name) for name in seen} <= allowed


def test_wrappers_see_what_the_robot_knows_alone():
    """Of the environment below them they touch its configuration, its explorer and its masks."""
    touched = {
        node.attr
        for name, tree in TREES.items()
        if part(name) == "wrappers"
        for node in ast.walk(tree)
        if isinstance(node, ast.Attribute) and ast.unparse(node.value) in ("env.unwrapped", "self.env.unwrapped")
    }
    assert touched == {"config", "explorer"}
    asked = [
        ast.unparse(node.args[0])
        for name, tree in TREES.items()
        if part(name) == "wrappers"
        for node in ast.walk(tree)
        if isinstance(node, ast.Call) and ast.unparse(node.func).endswith("get_wrapper_attr")
    ]
    assert asked == ["'action_masks'"]


def test_scripted_policies_act_on_the_observation_alone():
    scripted = {f"baselines.{name}" for name in SCRIPTED}
    allowed = scripted | {"polyexplore_gym.errors", "polyexplore_gym.config"}
    assert scripted <= set(MODULES)
    wrong = [where for name, imported, where in project_imports() if name in scripted and imported not in allowed]
    assert not wrong


def test_heavy_packages_are_imported_when_needed():
    wrong = []
    for name, tree in TREES.items():
        for node in top_level(tree) if name.startswith("polyexplore_gym") else ():
            if isinstance(node, (ast.Import, ast.ImportFrom)):
                wrong += [f"{name}:{line} {i}" for i, line in imports(name, node) if i.split(".")[0] in HEAVY]
    assert not wrong


def test_randomness_is_an_argument():
    wrong = []
    for name, tree in TREES.items():
        for node in ast.walk(tree):
            text = ast.unparse(node) if isinstance(node, (ast.Attribute, ast.Import, ast.ImportFrom, ast.Call)) else ""
            if isinstance(node, ast.Attribute) and ast.unparse(node.value) in ("np.random", "numpy.random"):
                bad = node.attr not in GENERATORS  # the global generator
            elif isinstance(node, (ast.Import, ast.ImportFrom)):
                found = [i for i, _ in imports(name, node)]
                bad = any(i.split(".")[0] in ("random", "secrets", "uuid") or i == "numpy.random" for i in found)
            elif isinstance(node, ast.Call) and ast.unparse(node.func).endswith("default_rng"):
                bad = not (node.args or node.keywords)  # seeded by the clock
            else:
                bad = False
            if bad:
                wrong.append(f"{name}:{node.lineno} {text}")  # type: ignore[attr-defined]
    assert not wrong


def loaded_by(statement: str) -> set[str]:
    code = f"import sys\n{statement}\nprint('\\n'.join(sys.modules))"
    return set(subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split())


@pytest.mark.parametrize(
    ("statement", "absent"),
    [
        ("import polyexplore_gym", {*HEAVY, "numba", "shapely", "pymunk", "scipy", "joblib", "tyro"}),
        ("import polyexplore_gym.env", HEAVY),
        ("import polyexplore_gym.explorer", {*HEAVY, "pymunk"}),
        ("import polyexplore_gym.wrappers", {*HEAVY, "numba", "pymunk", "shapely"}),
        ("import polyexplore_gym.cli", HEAVY),
        ("import polyexplore_gym.evaluation, baselines", {*HEAVY, "numba"}),
        ("import polyexplore_gym.rendering", HEAVY),
    ],
)
def test_what_an_import_loads(statement, absent):
    loaded = {name.split(".")[0] for name in loaded_by(statement)}
    # Gymnasium itself may bring some of them along.
    brought = {name.split(".")[0] for name in loaded_by("import gymnasium")}
    assert "polyexplore_gym" in loaded
    assert not (loaded & absent) - brought
    assert not brought & {"torch", "pygame", "matplotlib", "cv2", "numba"}
    if statement == "import polyexplore_gym":
        assert {name for name in loaded_by(statement) if name.startswith("polyexplore_gym.")} == set()
