"""Runs that are killed, interrupted or fail, and go on: the commands as a user meets them."""

from __future__ import annotations

import json
import shutil
import signal
import subprocess
import sys
import time
from functools import partial
from pathlib import Path

import pytest

import todframes as tod
from todframes.base.output import STAGING, STORE
from todframes.scoring import trial_scores as scoring_work


def started(package: str, *arguments: str | Path) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-m", package, *map(str, arguments)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def content(folder: Path) -> dict[str, bytes]:
    """The files of a result or dataset, without what tells time."""
    found = {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for path in folder.rglob("*")
        if path.is_file() and STAGING not in path.parts
    }
    if "result.json" in found:
        result = json.loads(found.pop("result.json"))
        found["fits"] = json.dumps(result["fits"]).encode()
        found.pop("report.html")
    return found


def spoil_last(path: Path) -> Path:
    """Cut the frame of the manifest's last row; its content before is beside it."""
    manifest = (path / "manifest.csv").read_text(encoding="utf-8").splitlines()
    frame = path / manifest[-1].partition(",")[0]
    shutil.copy(frame, frame.with_suffix(".whole"))
    frame.write_bytes(frame.read_bytes()[:100])
    return frame


@pytest.mark.usefixtures("blank_pictures")
def test_a_run_that_failed_goes_on(todframes, make_dataset, tmp_path: Path, monkeypatch) -> None:
    path = make_dataset(contrasts=(0.05, 0.1, 0.2, 0.4), repeats=8).path
    assert todframes("score", path, "-o", tmp_path / "undisturbed")[0] == 0
    frame = spoil_last(path)
    out = tmp_path / "out"
    status, _, err = todframes("score", path, "-o", out)
    assert status == 1
    error, note = err.splitlines()
    assert error.startswith(f"error: {frame}: ")
    assert note == f"note: what is finished is kept in {out}; the same command goes on where this one ended"
    assert [one.name for one in out.iterdir()] == [STAGING]
    frame.with_suffix(".whole").replace(frame)
    seen = []
    inner = scoring_work.TrialWork.function

    def counted(self):
        function = inner(self)
        return lambda trial: (seen.append(trial.number), function(trial))[1]

    monkeypatch.setattr(scoring_work.TrialWork, "function", counted)
    status, _, err = todframes("score", path, "-o", out)
    assert status == 0
    # 128 trials; the last one failed.
    assert err.splitlines()[0] == (
        "127 of 128 parts of the work are there from an earlier run; going on with the others"
    )
    assert len(seen) == 1
    assert json.loads((out / "result.json").read_bytes())["from_store"] == 127
    assert json.loads((tmp_path / "undisturbed" / "result.json").read_bytes())["from_store"] == 0
    assert content(out) == content(tmp_path / "undisturbed")
    assert not (out / STAGING).exists()


@pytest.mark.slow
def test_restart_and_keep_store(todframes, make_dataset, tmp_path: Path) -> None:
    path, out = make_dataset(contrasts=(0.05, 0.1, 0.2), repeats=4).path, tmp_path / "out"
    assert todframes("score", path, "-o", out, "--keep-store")[0] == 0
    whole = content(out)
    assert list((out / STAGING / STORE).iterdir())
    status, _, err = todframes("score", path, "-o", out, "--keep-store")
    assert status == 0
    assert err == "48 of 48 parts of the work are there from an earlier run; nothing is left to do\n"
    # Another criterion needs no trial again, another noise or seed all of them.
    assert "48 of 48" in todframes("score", path, "-o", out, "--keep-store", "--p-correct", "0.6")[2]
    for changed in (("--internal-noise", "0.4"), ("--seed", "2"), ("--set", "kernel_a=0.4")):
        assert todframes("score", path, "-o", tmp_path / "other", *changed)[0] == 0
        assert "beginning anew" in todframes("score", path, "-o", out, "--keep-store", *changed)[2]
        assert content(out)["scores.csv"] == content(tmp_path / "other")["scores.csv"]
    # A command of another kind leaves the store where it is.
    assert todframes("naked-eye", "--contrast", "1", "-o", out)[0] == 0
    assert list((out / STAGING / STORE).iterdir())
    status, _, err = todframes("score", path, "-o", out, "--restart")
    assert (status, err) == (0, "")
    assert not (out / STAGING).exists()
    assert {name: whole[name] for name in whole} == {name: content(out)[name] for name in whole}


@pytest.mark.parametrize(
    ("number", "workers"),
    [(signal.SIGINT, 1), *(pytest.param(n, 2, marks=pytest.mark.slow) for n in (signal.SIGINT, signal.SIGTERM))],
)
def test_an_interrupted_run_says_what_is_kept(make_dataset, tmp_path: Path, number, workers) -> None:
    path, out = make_dataset(contrasts=(0.05, 0.1, 0.2, 0.4), repeats=150).path, tmp_path / "out"
    process = started("todframes", "score", path, "-o", out, "--workers", str(workers))
    until_begun(out)
    process.send_signal(number)
    printed, err = process.communicate(timeout=60)
    assert (process.returncode, printed) == (130, "")
    assert {one.name for one in tmp_path.iterdir()} == {"dataset", "out"}
    assert [one.name for one in out.iterdir()] == [STAGING]
    assert err.splitlines() == [
        "error: interrupted",
        f"note: what is finished is kept in {out}; the same command goes on where this one ended",
    ]


def until_begun(out: Path) -> None:
    deadline = time.monotonic() + 60
    while not any(path.stat().st_size > 1_000 for path in out.glob(f"{STAGING}/{STORE}/*")):
        assert time.monotonic() < deadline
        time.sleep(0.01)


def test_a_frame_that_has_changed_is_scored_again(make_dataset, tmp_path: Path) -> None:
    """Its size is the same; its time is not."""
    path = make_dataset(contrasts=(0.05, 0.1, 0.2), repeats=4).path
    scored = partial(tod.score, path, fit=tod.FitSettings(resamples=0), store=tmp_path / "rows", examples=False)
    whole, again = scored(), scored()
    assert again.from_store == 48
    assert again.fits[0].threshold == whole.fits[0].threshold
    first = min((path / "frames").iterdir())
    first.write_bytes(first.read_bytes())
    assert scored().from_store == 47
