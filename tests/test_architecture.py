"""Who may import whom, what is never called, and what the package's public names are."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

import semantic2d_dataset
from tests.conftest import PROJECT

PACKAGES = ("semantic2d_dataset", "conversion", "salsa", "baselines", "leaderboard")
SIBLINGS = PACKAGES[1:]
ROOMS = (
    "errors",
    "scene",
    "format",
    "executors",
    "simulation",
    "scoring",
    "access",
    "plotting",
    "plotting_scores",
    "plotting_splits",
    "summaries",
    "reports",
    "comparing",
    "viewing",
    "corruption",
    "publishing",
    "pipeline",
    "loading",
    "cli_options",
    "cli_data",
    "cli_publishing",
    "cli_splits",
    "cli_table",
    "cli_scoring",
    "cli_corruption",
    "cli_submission",
    "cli",
)
FILES = [p for package in PACKAGES for p in sorted((PROJECT / package).rglob("*.py"))]


def imports_of(path):
    """Every module that a file imports, at its top or inside a function."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            yield node.module
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def find_breaches(path, imported):
    """What an import in a file breaks, in words."""
    parts = path.relative_to(PROJECT).with_suffix("").parts
    package, room = parts[0], parts[1]
    target = imported.split(".")
    if target[0] in SIBLINGS and target[0] != package:
        yield f"{package} imports {target[0]}"
    if package == "semantic2d_dataset" and target[0] == package and len(target) > 1:
        here, there = (ROOMS.index(r) if r in ROOMS else None for r in (room, target[1]))
        if here is not None and there is not None and there > here:
            yield f"{room} imports {target[1]}, which rests on it"
    if target[0] in ("torch", "safetensors"):
        allowed = package == "baselines" and path.name != "segmenter.py"
        if not allowed and not (room == "access" and path.name.startswith("torch_")):
            yield f"{target[0]} outside access/torch_*.py and baselines"
    if target[0] == "rosbags" and package != "conversion":
        yield "rosbags outside conversion"


@pytest.mark.parametrize("path", FILES, ids=lambda p: str(p.relative_to(PROJECT)))
def test_imports_follow_the_architecture(path):
    assert not [b for name in imports_of(path) for b in find_breaches(path, name)]


@pytest.mark.parametrize(
    ("path", "imported"),
    [
        ("salsa/alignment.py", "conversion.ros.bags"),
        ("semantic2d_dataset/format/sequence.py", "semantic2d_dataset.access.registry"),
        ("semantic2d_dataset/access/registry.py", "salsa"),
        ("semantic2d_dataset/scoring/metrics.py", "torch"),
        ("baselines/segmenter.py", "torch.nn"),
        ("leaderboard/table.py", "rosbags"),
    ],
)
def test_each_rule_finds_its_breach(path, imported):
    assert list(find_breaches(PROJECT / path, imported))


def test_every_room_of_the_core_has_its_place():
    found = {
        p.relative_to(PROJECT / "semantic2d_dataset").parts[0]
        for p in FILES
        if p.is_relative_to(PROJECT / "semantic2d_dataset")
    }
    assert {name.removesuffix(".py") for name in found} - {"__init__"} <= set(ROOMS)


def calls_of(path):
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Call):
            yield node, ast.unparse(node.func)


BANNED = {
    "eval",
    "exec",
    "input",
    "pickle.load",
    "pickle.loads",
    "yaml.load",
    "yaml.unsafe_load",
    "os.system",
    "tarfile.open.extractall",
}


@pytest.mark.parametrize("path", FILES, ids=lambda p: str(p.relative_to(PROJECT)))
def test_nothing_unsafe_is_called(path):
    for node, name in calls_of(path):
        where = f"{path}:{node.lineno}"
        assert name not in BANNED, where
        assert not name.endswith((".extractall", ".extract")), where
        options = {keyword.arg: keyword.value for keyword in node.keywords}
        if name in ("np.load", "numpy.load"):
            assert ast.unparse(options["allow_pickle"]) == "False", where
        if name == "torch.load":
            assert ast.unparse(options["weights_only"]) == "True", where
        if name.startswith("subprocess."):
            assert "shell" not in options, where


@pytest.mark.parametrize("path", FILES, ids=lambda p: str(p.relative_to(PROJECT)))
def test_input_is_not_checked_with_assert(path):
    tree = ast.parse(path.read_text(encoding="utf-8"))
    assert not [node.lineno for node in ast.walk(tree) if isinstance(node, ast.Assert)]


def test_public_names_are_pinned():
    assert sorted(semantic2d_dataset.__all__) == [
        "Evaluator",
        "History",
        "HokuyoUTM30LXEW",
        "LidarDataset",
        "LidarSpec",
        "Manifest",
        "OpenDataset",
        "Pose2",
        "RPLidarS2",
        "Scan",
        "ScanBatch",
        "Semantic2DError",
        "SemanticMap",
        "SequenceHeader",
        "SequenceReader",
        "SequenceWriter",
        "Shard",
        "SplitScheme",
        "Statistics",
        "Taxonomy",
        "WLR716",
        "dask_arrays",
        "load_dataset",
        "load_lidars",
        "open_dataset",
        "publish",
        "read_manifest",
        "scan_table",
    ]


def test_every_public_name_resolves():
    for name in semantic2d_dataset.__all__:
        assert getattr(semantic2d_dataset, name).__name__ == name
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        _ = semantic2d_dataset.nothing


HEAVY = ("torch", "numba", "h5py", "matplotlib", "scipy", "pandas", "rosbags", "numpy")


def modules_after(code):
    done = subprocess.run(
        [sys.executable, "-c", f"{code}\nimport sys\nprint(*sys.modules)"],
        capture_output=True,
        text=True,
        check=True,
        cwd=PROJECT,
    )
    return set(done.stdout.split()) & set(HEAVY)


def test_importing_the_package_and_its_command_loads_nothing_heavy():
    assert modules_after("import semantic2d_dataset") == set()
    assert modules_after("import semantic2d_dataset.cli") == set()


@pytest.mark.parametrize("package", SIBLINGS)
def test_importing_a_package_s_commands_loads_nothing_heavy(package):
    assert modules_after(f"import {package}.cli") == set()


@pytest.mark.parametrize(
    "module", ["scoring.metrics", "access.registry", "format.sequence", "simulation.mini"]
)
def test_what_needs_no_torch_loads_none(module):
    assert "torch" not in modules_after(f"import semantic2d_dataset.{module}")


def test_the_distribution_ships_exactly_these_packages():
    import tomllib

    settings = tomllib.loads((PROJECT / "pyproject.toml").read_text(encoding="utf-8"))
    shipped = settings["tool"]["setuptools"]["packages"]["find"]["include"]
    assert [name.removesuffix("*") for name in shipped] == list(PACKAGES)
    assert all(Path(PROJECT / package / "py.typed").exists() for package in PACKAGES)
