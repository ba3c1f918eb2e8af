"""`todframes sample` makes the sample frames of the repository again."""

from __future__ import annotations

from pathlib import Path

import numpy as np

import todframes as tod

SAMPLES = Path(__file__).parents[2] / "sample_frames"


def test_the_samples_are_those_of_the_repository(tmp_path, todframes):
    status, out, _ = todframes("sample", tmp_path / "made")
    made = {"naked_eye": 336, "staring_camera": 162}
    lines = [f"written: {tmp_path / 'made' / name}: {n} frames" for name, n in made.items()]
    assert (status, out.splitlines()) == (0, [*lines, f"Try: todframes score {tmp_path / 'made' / 'naked_eye'}"])
    for name, n_frames in made.items():
        ours, theirs = (sorted((root / name).rglob("*.*")) for root in (tmp_path / "made", SAMPLES))
        assert [path.name for path in ours] == [path.name for path in theirs]
        frames = [pair for pair in zip(ours, theirs, strict=True) if pair[0].suffix == ".exr"]
        assert len(frames) == n_frames
        # Frames of a simulated camera state the version that made them, so pixels are compared; a few are enough.
        for one, other in frames[:: n_frames // 20]:
            np.testing.assert_array_equal(tod.read_frame(one).values, tod.read_frame(other).values)
