"""A working folder of unknown origin: nothing in it is executed or obeyed but the modules that a user names."""

from __future__ import annotations

import subprocess
import sys
from importlib.metadata import entry_points
from pathlib import Path

import matplotlib as mpl
import pytest

from todframes.base.user_code import import_named
from todframes.enhancement.finding import ENTRY_POINT_GROUP, find_enhancement
from todframes.results.figures import new_figure, save_png, style

OWN_WORK = """\
class Name:
    def function(self):
        return str
    def name(self, item):
        return str(item)
"""

ENGINE = """\
from todframes.jobs.run import open_engine
from todframes.base.user_code import import_named
work = import_named("own_work", "Name", "work")()
with open_engine({!r}, 2) as engine:
    assert list(engine.run(work, [(0, 1)])) == [(0, "1")]
"""

PROCESSES = {
    "processes": ENGINE.format(None),
    "live curves": "from sensor_sim.explorer.live import LiveCurves\nLiveCurves(1).close()\n",
}


@pytest.mark.parametrize("kind", ["processes", pytest.param("live curves", marks=pytest.mark.slow)])
def test_processes_import_nothing_from_the_working_folder(working_folder: Path, kind: str) -> None:
    """Python imports the first of these modules as soon as it has started, the others on the way."""
    for name in ("multiprocessing", "struct", "socket", "threading", "msvcrt", "numpy", "usercustomize"):
        (working_folder / f"{name}.py").write_text("open('executed', 'w').close()\n", encoding="utf-8")
    (working_folder / "own_work.py").write_text(OWN_WORK, encoding="utf-8")
    script = working_folder.parent / "script.py"
    script.write_text(f"if __name__ == '__main__':\n    {'    '.join(PROCESSES[kind].splitlines(keepends=True))}")
    process = subprocess.run([sys.executable, script], capture_output=True, text=True, timeout=120, check=False)
    assert (process.returncode, process.stderr) == (0, "")
    assert not (working_folder / "executed").exists()


def test_processes_that_would_ignore_the_safe_path_are_refused(working_folder: Path) -> None:
    code = "from todframes.jobs.start import starting_processes\nwith starting_processes():\n    pass\n"
    script = working_folder.parent / "script.py"
    script.write_text(code, encoding="utf-8")
    process = subprocess.run([sys.executable, "-E", script], capture_output=True, text=True, check=False)
    assert process.returncode == 1
    assert "found python -E, whose processes search the current folder; expected python -I" in process.stderr


def test_metadata_in_the_working_folder_register_nothing(working_folder: Path) -> None:
    (working_folder / "own_code.py").write_text("def soft(image):\n    return image\n", encoding="utf-8")
    (working_folder / "decoy.py").write_text("def clahe(image):\n    return image * 0\n", encoding="utf-8")
    metadata = working_folder / "decoys-1.0.dist-info"
    metadata.mkdir()
    (metadata / "METADATA").write_text("Metadata-Version: 2.1\nName: decoys\nVersion: 1.0\n", encoding="utf-8")
    (metadata / "entry_points.txt").write_text(f"[{ENTRY_POINT_GROUP}]\nclahe = decoy:clahe\n", encoding="utf-8")
    find_enhancement("own_code:soft")
    assert "decoy:clahe" not in {entry.value for entry in entry_points(group=ENTRY_POINT_GROUP)}
    assert find_enhancement("clahe").function.__module__ == "todframes.enhancement.builtin"
    assert import_named("decoy", "clahe", "enhance").__module__ == "decoy"


def test_settings_of_plots_in_the_working_folder_are_not_read(working_folder: Path) -> None:
    (working_folder / "matplotlibrc").write_bytes(b"axes.facecolor: \xff\n")
    code = "from todframes.__main__ import start; start(); import matplotlib.figure"
    process = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert (process.returncode, process.stderr) == (0, "")


@pytest.mark.parametrize("settings", [{"axes.facecolor": "red"}, {"font.size": 30.0}, {"text.usetex": True}])
def test_pictures_do_not_depend_on_the_users_settings(settings: dict[str, object]) -> None:
    def picture() -> bytes:
        with style():
            figure, axes = new_figure()
            axes.plot([0.0, 1.0], label="line")
            return save_png(figure, "A note")

    expected = picture()
    with mpl.rc_context(settings):  # type: ignore[arg-type]
        assert picture() == expected
