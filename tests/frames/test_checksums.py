"""Frames that nothing checks are told of, and `validate --add-sha256` has them checked."""

from __future__ import annotations

import hashlib
import os
import re
from pathlib import Path

import pytest

from todframes.base import output
from todframes.base.errors import DataError, FrameError
from todframes.frames import dataset_files
from todframes.frames.dataset import dataset_warnings, load_dataset
from todframes.frames.dataset_files import write_sha256
from todframes.frames.files import has_own_checksums, read_frame, write_frame

ROOT = Path(__file__).parents[2]
SAMPLES = ["naked_eye", "grabbed_8bit", "staring_camera", "enhancement"]


def sha256(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def test_validate_warns_too(make_dataset, todframes) -> None:
    made = make_dataset()
    status, out, err = todframes("validate", made.path)
    assert (status, out) == (0, f"{made.path}: 8 frames in 8 trials, all readable; 1 warning\n")
    assert err.startswith("warning: 8 of 8 frames are EXR without a sha256")


def test_frames_left_out_are_not_counted(make_dataset) -> None:
    data = load_dataset(make_dataset().path)
    assert dataset_warnings(data, data.trials[:3])[0].found == 3
    assert [warning.code for warning in dataset_warnings(data, data.trials[:0])] == ["group_left_out"]


def test_png_has_checksums_whatever_its_name(make_dataset) -> None:
    made = make_dataset(suffix=".png")
    made.frame(0).rename(made.path / "frames" / "first.exr")
    made.rows[0]["frame"] = "frames/first.exr"
    made.save()
    data = load_dataset(made.path)
    assert dataset_warnings(data, data.trials) == []
    with pytest.raises(FrameError, match="frames: found a folder or device, expected an EXR or PNG file"):
        has_own_checksums(made.path / "frames")


@pytest.mark.parametrize("name", SAMPLES)
def test_samples_are_checked(name: str) -> None:
    data = load_dataset(ROOT / "sample_frames" / name)
    assert all(frame.sha256 for trial in data.trials for frame in trial.frames)
    assert dataset_warnings(data, data.trials) == []


@pytest.mark.parametrize("end", ["\n", "\r\n"])
@pytest.mark.parametrize("mark", ["", "\ufeff"])
def test_column_is_added(make_dataset, todframes, mark: str, end: str) -> None:
    """All else stays: quoted fields, empty lines, line ends, byte-order mark, the file's mode."""
    made = make_dataset(contrasts=(0.5,))
    for number, row in enumerate(made.rows):
        row["remark"] = ["", "a, b", 'say "x"', "two\nlines"][number]
    made.save()
    before = mark + made.manifest_file.read_text(encoding="utf-8").replace("\n", end) + end
    before = before.replace(f"two{end}lines", "two\nlines")
    made.manifest_file.write_bytes(before.encode())
    made.manifest_file.chmod(0o640)
    status, out, err = todframes("validate", made.path, "--add-sha256")
    assert (status, err) == (0, "")
    assert out.splitlines()[1] == f"{made.manifest_file}: sha256 of 4 frames added; 0 had one, and agree"
    expected = before.replace(f"remark{end}", f"remark,sha256{end}")
    for number, field in enumerate(["", '"a, b"', '"say ""x"""', '"two\nlines"']):
        expected = expected.replace(f"0.5,{field}{end}", f"0.5,{field},{sha256(made.frame(number))}{end}")
    assert made.manifest_file.read_bytes().decode() == expected
    assert made.manifest_file.stat().st_mode & 0o777 == 0o640
    assert [path.name for path in made.path.iterdir() if path.name.startswith(".")] == []


def test_only_empty_fields_are_filled(make_dataset, todframes) -> None:
    """A value stays as it was written, and a second run has nothing to do."""
    made = make_dataset()
    for row in made.rows:
        row |= {"sha256": "", "note": "last"}
    made.rows[2]["sha256"] = sha256(made.frame(2)).upper()
    made.save()
    assert "sha256 of 7 frames added; 1 had one" in todframes("validate", made.path, "--add-sha256")[1]
    for number, row in enumerate(made.rows):
        row["sha256"] = row["sha256"] or sha256(made.frame(number))
    written = made.manifest_file.read_bytes()
    made.save()
    assert made.manifest_file.read_bytes() == written
    modified = made.manifest_file.stat().st_mtime_ns
    assert "sha256 of 0 frames added; 8 had one" in todframes("validate", made.path, "--add-sha256")[1]
    assert made.manifest_file.stat().st_mtime_ns == modified


def cut_short(frame):
    frame.write_bytes(frame.read_bytes()[:200])


@pytest.mark.parametrize(
    ("spoil", "changes"),
    [(cut_short, {}), (Path.unlink, {}), (Path.touch, {5: {"sha256": "0" * 64}})],
    ids=["damaged", "missing", "another checksum"],
)
def test_a_bad_frame_leaves_the_manifest(make_dataset, todframes, spoil, changes) -> None:
    made = make_dataset(row_changes=changes)
    before = made.manifest_file.read_bytes()
    spoil(made.frame(5))
    status, out, err = todframes("validate", made.path, "--add-sha256")
    assert (status, out) == (1, "")
    assert str(made.frame(5)) in err.splitlines()[0]
    assert made.manifest_file.read_bytes() == before


def test_manifest_that_changes_meanwhile(make_dataset) -> None:
    made = make_dataset()
    data = load_dataset(made.path)
    sums = {frame.path: "0" * 64 for trial in data.trials for frame in trial.frames}
    made.rows[0]["frame"] = "frames/other.exr"
    made.save()
    before = made.manifest_file.read_bytes()
    with pytest.raises(DataError, match=r"manifest\.csv: was changed while its frames were checked, nothing was"):
        write_sha256(data, sums)
    assert made.manifest_file.read_bytes() == before


def test_manifest_that_cannot_be_written(make_dataset, todframes, monkeypatch) -> None:
    """Told before the work where that is possible; a failure while writing leaves the old file, and no other."""
    made = make_dataset()
    before = made.manifest_file.read_bytes()

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    for broken in (
        (output, "write_files", full),
        (dataset_files.os, "access", lambda _, mode: not mode & os.W_OK),
    ):
        with monkeypatch.context() as patch:
            patch.setattr(*broken)
            status, _, err = todframes("validate", made.path, "--add-sha256")
        assert (status, len(err.splitlines())) == (2, 1)
        assert f"{made.manifest_file}: cannot be written" in err
        assert made.manifest_file.read_bytes() == before
        assert sorted(path.name for path in made.path.iterdir()) == ["dataset.toml", "frames", "manifest.csv"]


def test_manifest_behind_a_link(make_dataset, todframes) -> None:
    made = make_dataset()
    made.manifest_file.rename(made.path / "shared.csv")
    made.manifest_file.symlink_to(made.path / "shared.csv")
    assert todframes("validate", made.path, "--add-sha256")[0] == 0
    assert made.manifest_file.is_symlink()
    assert "sha256" in (made.path / "shared.csv").read_text(encoding="utf-8")


def test_what_headers_state_is_in_a_warning_of_the_dataset(make_dataset) -> None:
    """A frame of each trial is looked at; one of the eight is damaged, which scoring reports."""
    made = make_dataset(suffix=".exr")
    for number in (1, 4):
        write_frame(made.frame(number), read_frame(made.frame(number)).values, compression="dwaa")
    made.frame(7).write_bytes(b"no frame")
    data = load_dataset(made.path)
    (found,) = (one for one in dataset_warnings(data, data.trials) if one.code != "unverified_frames")
    assert (found.code, found.found, found.expected) == ("lossy_compression", 2 / 7, 0.0)
    assert re.search(r"^frames/\S+\.exr: EXR by dwaa changes pixels.* \(2 of 7 frames looked at\)$", found.message)
