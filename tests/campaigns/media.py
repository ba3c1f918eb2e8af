"""The campaigns of damaged recordings and of bombs: each ends in a result or in one clear line, in little memory.

Samples of every kind are written by PyAV, OpenImageIO, NumPy, and by hand (`tests/test_recordings.py`).
"""

from __future__ import annotations

import json
import os
import shutil
import struct
import subprocess
import sys
import tempfile
from pathlib import Path

import damage
import numpy as np
from mutations import Mutation, Rng, fill_range, flip_bits, insert_bytes, rename_format, splice_files, truncate

sys.path.insert(0, str(Path(__file__).parents[1]))

import test_frame_limit as limits
import test_recorded_video as videos
import test_recordings as stills

LARGEST_BOMB_MB = 200
"""Limit of the memory that refusing a bomb may take, libraries included."""

SHAPE = (48, 70)

SCHEDULE = "orientation,size_px,contrast\nup,9,0.5\n"


def claim_more(content: bytes, rng: Rng, _: object) -> bytes:
    """Replace a number of two or four bytes by another of any size: most are sizes, offsets or counts."""
    kind = "<>"[rng.integers(2)] + "HI"[rng.integers(2)]
    place = int(rng.integers(max(min(len(content), 4096) - 4, 1)))
    value = int(2 ** rng.uniform(0, 8 * struct.calcsize(kind))) - 1
    return content[:place] + struct.pack(kind, value) + content[place + struct.calcsize(kind) :]


MEDIA: dict[str, Mutation] = {
    "bit flips": flip_bits,
    "truncation": truncate,
    "range of zeros or ones": fill_range,
    "bytes put in or taken out": insert_bytes,
    "another number": claim_more,
    "two files spliced": splice_files,
    "another format under the name": rename_format,
}


def write_samples(folder: Path) -> list[Path]:
    """Write a small recording of every kind."""
    rng = np.random.default_rng(1)
    counts = rng.integers(1, 60_000, (5, *SHAPE)).astype(np.uint16)
    grey = [[one] for one in counts]
    colour = [[one >> 8, one >> 8, one >> 8] for one in counts]
    colour = [[plane.astype(np.uint8) for plane in planes] for planes in colour]
    for name in ("ffv1.mkv", "ffv1.avi", "ffv1.nut"):
        videos.encode(folder / name, grey, "gray16le")
    for name in ("h264.mp4", "h264.ts"):
        videos.encode(folder / name, colour, "yuv444p", codec="libx264")
    videos.encode(folder / "raw.avi", [[planes[0]] for planes in colour], "gray", codec="rawvideo")
    limits.video(folder / "png.mov", "png", "rgb24", counts[0])
    limits.video(folder / "mjpeg.avi", "mjpeg", "yuvj420p", counts[0])
    np.save(folder / "a.npy", counts)
    np.savez(folder / "plain.npz", counts)
    np.savez_compressed(folder / "deflated.npz", counts)
    for name in ("a.tif", "a.dpx", "a.jp2", "a.ppm"):
        stills.write_image(folder / name, rng.integers(0, 65536, (128, 160, 3)).astype(np.uint16))
    stills.write_image(folder / "a.jpg", rng.integers(0, 256, (128, 160, 3)).astype(np.uint8))
    (folder / "a.fff").write_bytes(stills.fff(counts[0]))
    (folder / "a.seq").write_bytes(stills.seq(*counts))
    smooth = stills.scene(5, SHAPE)
    (folder / "png.fff").write_bytes(stills.fff(smooth[0], image=stills.png(smooth[0])))
    (folder / "a.csq").write_bytes(
        b"".join(
            stills.fff(one, image=stills.jpeg_ls(one), moment_ms=5000 + 40 * k) for k, one in enumerate(smooth)
        )
    )
    (folder / "a.ptw").write_bytes(stills.ptw(smooth, 0.04 * np.arange(1, 6)))
    stills.dng(folder / "a.dng", rng.integers(600, 16000, (64, 96)).astype(np.uint16), black=512, white=16383)
    return sorted(folder.iterdir())


class Child(damage.Child):
    """The cases of damaged recordings, in a folder of its own."""

    largest_mb = 1800  # `noise` takes about 50 bytes a pixel, and a frame has 33 million at most

    def __init__(self, seed: int, folder: Path) -> None:
        self._seed, self._folder = seed, folder
        (folder / "samples").mkdir()
        self._samples = {path.name: path.read_bytes() for path in write_samples(folder / "samples")}
        self._others = list(self._samples.values())
        (folder / "schedule.csv").write_text(SCHEDULE, encoding="utf-8")
        self._runner = damage.Runner(folder)
        for name, content in self._samples.items():
            for ran in (self._noise(name, content), self._import(name, content)):
                if ran.status:
                    raise RuntimeError(f"{name}: {ran.err}")

    def _case(self, rng: Rng) -> tuple[str, tuple[str, bool, str]]:
        name = list(self._samples)[rng.integers(len(self._samples))]
        kind = list(MEDIA)[rng.integers(len(MEDIA))]
        mutated = MEDIA[kind](self._samples[name], rng, self._others)
        is_noise = bool(rng.random() < 0.5)
        ran = (self._noise if is_noise else self._import)(name, mutated)
        case = f"{name.rpartition('.')[2]}, {'noise' if is_noise else 'import'}: {kind}"
        if ran.status:
            return case, damage.judge_refusal(ran, name)
        if is_noise:
            json.loads(ran.out, parse_constant=damage.refuse_constant)
        is_odd = any(not damage.ASIDE.match(line) for line in ran.err.splitlines())
        return case, ("a result", is_odd, ran.err)

    def _noise(self, name: str, content: bytes) -> damage.Ran:
        (self._folder / name).write_bytes(content)
        return self._runner.run("todframes", "noise", name, "--json", "--quiet")

    def _import(self, name: str, content: bytes) -> damage.Ran:
        (self._folder / name).write_bytes(content)
        shutil.rmtree(self._folder / "out", ignore_errors=True)
        rest = (
            "--schedule",
            "schedule.csv",
            "--range",
            "0:65535",
            "--integration-time",
            "all",
            "-o",
            "out",
            "--quiet",
        )
        return self._runner.run("todframes", "import", name, *rest)


# Bombs ---------------------------------------------------------------------------------------------------------


def huge_image(path: Path) -> None:
    """Write 16,000 × 16,000 zeros of a format that compresses them."""
    import OpenImageIO as oiio

    side = 16000
    spec = oiio.ImageSpec(side, side, 3, "half" if path.suffix == ".exr" else "uint8")
    output = oiio.ImageOutput.create(str(path))
    assert output.open(str(path), spec), output.geterror()
    rows = np.zeros((400, side, 3), np.float16 if path.suffix == ".exr" else np.uint8)
    for row in range(0, side, 400):
        assert output.write_scanlines(row, row + 400, 0, rows), output.geterror()
    assert output.close()


def claiming_array(path: Path) -> None:
    """Write the header of an array of 4 GB a frame."""
    path.write_bytes(stills.npy_claiming((2, 32000, 32000), "<f4"))


def claiming_fff(path: Path) -> None:
    """Write a container whose counts claim 32,000 × 32,000 pixels."""
    content = bytearray(stills.fff(np.zeros((40, 50))))
    place = len(content) - 2 * 40 * 50 - 32
    content[place + 2 : place + 6] = struct.pack("<2H", 32000, 32000)
    path.write_bytes(content)


def claiming_csq(path: Path) -> None:
    """Write a container whose counts are a JPEG-LS of 30,000 × 30,000 pixels."""
    counts = np.zeros((40, 50), np.uint16)
    content = stills.fff(counts, image=stills.jpeg_ls(counts))
    for old, new in ((struct.pack("<2H", 50, 40), "<2H"), (struct.pack(">2H", 40, 50), ">2H")):
        assert old in content
        content = content.replace(old, struct.pack(new, 30000, 30000))
    path.write_bytes(content)


def claiming_ptw(path: Path) -> None:
    """Write a film whose frames claim 32,000 × 32,000 pixels each, and of which there are 2³¹ − 1."""
    content = bytearray(stills.ptw(np.zeros((1, 40, 50), np.uint16), [1.0], words=508 + 32000**2))
    struct.pack_into("<i", content, 27, 2**31 - 1)
    struct.pack_into("<2H", content, 377, 32000, 32000)
    path.write_bytes(content)


def claiming_dng(path: Path) -> None:
    """Write a camera raw that claims 20,000 × 20,000 pixels."""
    stills.dng(path, np.full((64, 96), 600, np.uint16), black=0, white=1000, mosaic=False)
    content = path.read_bytes()
    for tag, side in ((256, 96), (257, 64), (278, 64)):
        old = struct.pack("<HHII", tag, 4, 1, side)
        assert old in content
        content = content.replace(old, struct.pack("<HHII", tag, 4, 1, 20000))
    path.write_bytes(
        content.replace(
            struct.pack("<HHII", 279, 4, 1, 64 * 96 * 2), struct.pack("<HHII", 279, 4, 1, 20000**2 * 2)
        )
    )


BOMBS = {
    "ffv1.mkv": limits.enlarged_mkv,
    "png.mov": limits.enlarged_png_in_mov,
    "header.npz": limits.npz_with_a_long_header,
    "a.npy": claiming_array,
    "a.png": limits.flat_png,
    "a.tif": huge_image,
    "a.jpg": huge_image,
    "a.exr": huge_image,
    "a.jp2": huge_image,
    "a.fff": claiming_fff,
    "a.csq": claiming_csq,
    "a.ptw": claiming_ptw,
    "a.dng": claiming_dng,
}


def bombs(only: str = "") -> tuple[int, int]:
    """Read each bomb by `noise` and by `import`, and print the memory. Returns the numbers of cases and faults."""
    n_cases = n_faults = 0
    with tempfile.TemporaryDirectory() as made:
        folder = Path(made)
        (folder / "schedule.csv").write_text(SCHEDULE, encoding="utf-8")
        for name, make in BOMBS.items():
            if only not in name:
                continue
            make(folder / name)
            for command in (("noise",), ("import", "--schedule", "schedule.csv", "-o", "out", "--range", "0:1")):
                arguments = [sys.executable, "-c", limits.PEAK, command[0], name, *command[1:]]
                ran = subprocess.run(arguments, capture_output=True, text=True, check=False, cwd=folder)
                *lines, peak = ran.stderr.splitlines()
                peak_mb = float(peak.split()[-1])
                refused = damage.Ran(ran.returncode, ran.stdout, "\n".join(lines))
                ending, is_fault, _ = damage.judge_refusal(refused, name)
                is_fault = is_fault or peak_mb > LARGEST_BOMB_MB
                n_cases, n_faults = n_cases + 1, n_faults + is_fault
                size_kb = (folder / name).stat().st_size / 1000
                print(
                    f"{'FAULT ' * is_fault}{name}, {size_kb:.0f} kB, {command[0]}: {ending}, {peak_mb:.0f} MB: "
                    f"{' '.join(lines)[:300]}"
                )
            (folder / name).unlink()
    return n_cases, n_faults


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as _folder:
        os.chdir(_folder)
        sys.exit(damage.main(int(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3]), Path(sys.argv[4]), kind=Child))
