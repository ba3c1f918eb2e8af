"""`todframes sample` makes the sample frames of the repository again."""

from __future__ import annotations

from pathlib import Path

import todframes as tod

SAMPLES = Path(__file__).parent.parent / "sample_frames"


def test_the_samples_are_those_of_the_repository(tmp_path):
    made = tod.sample(tmp_path / "made")
    assert made == {"naked_eye": 336, "staring_camera": 162}
    files = [path for path in (tmp_path / "made").rglob("*") if path.is_file()]
    assert len(files) == sum(made.values()) + 2 * len(made) + 1
    different = [
        path.name
        for path in files
        if path.read_bytes() != (SAMPLES / path.relative_to(tmp_path / "made")).read_bytes()
    ]
    assert different == []
