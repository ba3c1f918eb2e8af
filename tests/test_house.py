"""The house keeps its floors: a module imports only from floors below its own."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

import todframes

FLOORS = {
    "todframes": [
        {"errors", "weibull", "crossing", "timing", "figure_style", "likeness", "signals", "safe_text"},
        {"settings", "threads", "output"},
        {"result", "user_code"},
        {"verdict"},
        {"stimulus", "frames", "retina", "pyramid", "tetrahedron", "resampling", "display"},
        {"decision", "edgeworth", "planning", "stability", "pyramid_settings"},
        {"readout", "counts", "psychometric", "frame_writing", "estimators", "enhancement"},
        {"summed_noise", "gabor", "dataset", "accuracy", "pairing", "enhancement_specs", "algorithms"},
        {"observer"},
        {"informative", "oriented"},
        {"placing", "naked_eye"},
        {"viewing"},
        {"score_planning", "locating", "accuracy_scenes", "enhanced"},
        {"trial_scoring", "enhanced_reading"},
        {"scoring", "accuracy_recorded"},
        {"comparing"},
        {"stability_data_cases", "stability_observer_cases"},
        {"report", "examples", "figures", "report_tables", "tables"},
        {"compare_examples", "compare_report", "checksums"},
        {"plots", "svg_figures", "scene_report", "accuracy_figures"},
        {"compare_plot"},
        {"compare_tables"},
        {"html_report", "accuracy_report"},
        {"command", "stability_cases"},
        {"cli_studies", "cli_report", "cli_locating"},
        {"cli_compare"},
        {"cli"},
    ],
    "sensor_sim": [
        {"sensor", "crossing"},
        {"transfer"},
        {"sampling", "noise", "reconstruction"},
        {"folding", "simulate", "literal", "scenes", "stability_optics_cases", "matched"},
        {"curve_plan"},
        {"planning"},
        {"predict"},
        {"pictures", "stability_cases", "accuracy_scenes"},
        {"cli"},
    ],
}
ROOT = Path(todframes.__file__).parent.parent
MODULES = [
    (package, path.stem)
    for package in FLOORS
    for path in sorted((ROOT / package).glob("*.py"))
    if not path.stem.startswith("__")
]


def imported_modules(package: str, module: str) -> set[tuple[str, str]]:
    """(package, module) of everything of ours that a module imports, inside functions too."""
    tree = ast.parse((ROOT / package / f"{module}.py").read_text(encoding="utf-8"))
    found = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and node.module:
            head, _, rest = node.module.partition(".")
            names = [rest.split(".")[0]] if rest else [alias.name for alias in node.names]
            found |= {(head, name) for name in names if head in FLOORS}
        elif isinstance(node, ast.Import):
            parts = [alias.name.split(".") for alias in node.names]
            found |= {(part[0], part[1]) for part in parts if part[0] in FLOORS and len(part) > 1}
    return {(head, name) for head, name in found if not name.startswith("__")}


def floor(package: str, module: str) -> int:
    (level,) = [level for level, modules in enumerate(FLOORS[package]) if module in modules]
    return level


def test_every_module_has_a_floor() -> None:
    assert {package for package, _ in MODULES} == set(FLOORS)
    assert all(any(module in modules for modules in FLOORS[package]) for package, module in MODULES)


@pytest.mark.parametrize(("package", "module"), MODULES)
def test_imports_go_down(package: str, module: str) -> None:
    for other_package, other in imported_modules(package, module):
        if other_package == package:
            assert floor(package, other) < floor(package, module), f"{module} imports {other}"
        else:
            assert (package, other_package) == ("sensor_sim", "todframes"), f"{package} imports {other_package}"


def test_only_two_modules_open_images() -> None:
    paths = [ROOT / package / f"{module}.py" for package, module in MODULES]
    assert [path.stem for path in paths if "import OpenImageIO" in path.read_text(encoding="utf-8")] == [
        "frame_writing",
        "frames",
    ]
