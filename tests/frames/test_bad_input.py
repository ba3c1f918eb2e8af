"""Bad input: one line that says what is wrong and where, a status, and nothing half-written.

Each case spoils good input in one way; `wanted` are patterns for what the line must say. All cases meet the call
that reads such input, whose error a command prints; a few of each kind go through the commands.
"""

import errno
import json
import os
import re
import shlex
import shutil
import signal
import struct
import subprocess
import sys
import zlib
from contextlib import contextmanager
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
from test_frames import png_chunk

from todframes.base import output
from todframes.base.errors import DataError, FrameError, SettingsError
from todframes.base.reading import read_csv
from todframes.cli import main as cli
from todframes.cli.console import run
from todframes.cli.options import make_observers
from todframes.frames.contrast import frame_problems
from todframes.frames.dataset import load_dataset
from todframes.frames.files import write_frame
from todframes.observers.pyramid import PyramidObserver
from todframes.psychometrics.fit import FitSettings, read_counts
from todframes.scoring.score import score_dataset

pytestmark = pytest.mark.usefixtures("blank_pictures")

BAD_DATA, BAD_SETTINGS, INTERRUPTED = 1, 2, 130
BAD = 1
"""Number of the row that is spoilt; the manifest has the header in line 1."""
BAD_LINE = "line 3"

COMMAND = (sys.executable, "-c", "from todframes.cli.main import main; main()")


@pytest.fixture
def todframes(capfd):
    """Runs a command line; status, standard output, lines of standard error but for warnings.

    Of the file descriptors, as image libraries write to those.
    """

    def command_line(*arguments):
        capfd.readouterr()
        status = run(cli.cli, [str(argument) for argument in arguments])
        out, err = capfd.readouterr()
        # Where checksums are right but the pixels end early, libpng prints a line of its own before ours. The
        # frames are EXR without checksums, which is no error and has tests of its own.
        aside = "libpng error: Not enough image data", "warning: "
        errors = [line for line in err.splitlines() if not line.startswith(aside)]
        return status, out, errors

    return command_line


@pytest.fixture
def fails(todframes, tmp_path):
    """Runs a command line that must fail as the contract says, with a line that has all the patterns."""

    def command_line(*arguments, status, wanted, kept=None):
        before = tree(tmp_path)
        found, out, errors = todframes(*arguments)
        if kept is not None and len(errors) > 1:
            assert errors.pop().startswith(f"note: what is finished is kept in {kept}; ")
            assert [path.name for path in kept.iterdir()] == [".todframes-staging"]
            shutil.rmtree(kept)
        assert len(errors) == 1, errors
        assert_says(errors[0], wanted)
        assert errors[0].startswith("error: ")
        assert out == ""
        assert found == status, errors
        assert tree(tmp_path) == before

    return command_line


def assert_says(line, wanted):
    missing = [pattern for pattern in wanted if not re.search(pattern, line)]
    assert not missing, f"{line!r} lacks {missing}"


@contextmanager
def refused(kind, wanted):
    """The block must raise an error of this very kind, in one line with all the patterns."""
    with pytest.raises(kind, match=wanted[0]) as caught:
        yield
    assert caught.type is kind
    assert_says(str(caught.value), ("^[^\n]*$", *wanted))


def score(data, *, skip_bad_frames=False):
    settings = FitSettings(resamples=0)
    return score_dataset(data, PyramidObserver(), fit_settings=settings, skip_bad_frames=skip_bad_frames)


def assert_spoils(dataset, bad, wanted, kind=DataError):
    """A bad row or frame stops a score, or is skipped and listed; checking finds it and nothing else."""
    data = load_dataset(dataset.path)
    with refused(kind, wanted):
        score(data)
    scored = score(data, skip_bad_frames=True)
    assert [one.frame for one in scored.skipped] == [dataset.rows[bad]["frame"].strip()]
    assert_says(scored.skipped[0].error, wanted)
    assert sum(group.fit.n_trials for group in scored.fits) == len(dataset.rows) - 1
    problems = [row.error for row in data.bad_rows]
    problems += [str(error) for trial in data.trials for error in frame_problems(data, trial)]
    assert len(problems) == 1, problems
    assert_says(problems[0], wanted)


def tree(folder):
    return {path: path.is_dir() or path.lstat().st_mtime_ns for path in folder.rglob("*")}


def png(width, height, *chunks):
    """An 8-bit grey PNG of any declared size around the given chunks."""
    header = png_chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0))
    return b"\x89PNG\r\n\x1a\n" + header + b"".join(chunks) + png_chunk(b"IEND", b"")


def zeros_deflated(n_mib):
    """A zlib stream of so many MiB of zeros, without deflating more than one."""
    deflater = zlib.compressobj(9, wbits=-15)
    block = deflater.compress(bytes(2**20)) + deflater.flush(zlib.Z_FULL_FLUSH)
    adler32 = (n_mib * 2**20 % 65521) << 16 | 1
    return b"\x78\x01" + block * n_mib + b"\x03\x00" + struct.pack(">I", adler32)


def exr_window(path, width, height):
    """Changes the declared size of an EXR, both windows."""
    content = bytearray(path.read_bytes())
    for name in (b"dataWindow", b"displayWindow"):
        place = content.index(name + b"\0box2i\0") + len(name) + len("\0box2i\0") + 4
        content[place : place + 16] = struct.pack("<4i", 0, 0, width - 1, height - 1)
    path.write_bytes(content)


def flip(path, place):
    content = bytearray(path.read_bytes())
    content[place] ^= 0x10
    path.write_bytes(content)


def flip_exr_header(path):
    flip(path, path.read_bytes().index(b"compression\0") + len(b"compression\0com"))


def flip_middle(path):
    flip(path, path.stat().st_size * 2 // 3)


def flip_exr_data(path):
    """With pixels that fill most of the file: in chunk sizes and offsets some flips do no harm."""
    write_frame(path, 50.0 + np.random.default_rng(0).integers(0, 4, (48, 48)))
    flip_middle(path)


def truncate(path):
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def with_pixel(value):
    def spoil(path):
        """Half floats without compression, so that their bytes can be set."""
        pixels = np.full((48, 48), 50.0)
        pixels[20, 30] = 51.0
        write_frame(path, pixels, compression="none")
        content = path.read_bytes()
        assert content.count(np.float16(51.0).tobytes()) == 1
        path.write_bytes(content.replace(np.float16(51.0).tobytes(), np.float16(value).tobytes()))

    return spoil


def replaced_by_folder(path):
    path.unlink()
    path.mkdir()


def replaced_by_pipe(path):
    path.unlink()
    os.mkfifo(path)


def holding(content):
    return lambda path: path.write_bytes(content)


EITHER_WAY = "cannot be (opened|decoded)"
EXR = {
    "missing": (Path.unlink, "No such file"),
    "folder": (replaced_by_folder, "folder.*expected"),
    "pipe": (replaced_by_pipe, "device.*expected"),
    "empty": (holding(b""), "empty.*EXR or PNG"),
    "jpeg": (holding(b"\xff\xd8\xff\xe0" + bytes(99)), "is a JPEG file, expected EXR or PNG: its compression"),
    "tiff": (holding(b"II*\0" + bytes(99)), "is a TIFF file, expected EXR or PNG: convert it without loss"),
    "video": (holding(b"\0\0\0\x20ftypisom" + bytes(99)), "is a mov video file, .*each of its frames"),
    "git lfs": (holding(b"version https://git-lfs.github.com/spec/v1\n"), "Git LFS pointer file, .*git lfs pull"),
    "truncated": (truncate, EITHER_WAY),
    "header flipped": (flip_exr_header, EITHER_WAY),
    "data flipped": (flip_exr_data, "rows .* cannot be decoded"),
    "declares 60000": (lambda path: exr_window(path, 60_000, 60_000), "60000.*32768"),
    "declares too many bytes": (lambda path: exr_window(path, 30_000, 30_000), r"\d MB|image size"),
    "declares a negative size": (lambda path: exr_window(path, -5, 10), "cannot be opened|found"),
    "nan": (with_pixel(np.nan), "1 pixels are NaN or infinite.*row 20, column 30"),
    "too small": (lambda path: write_frame(path, np.full((5, 6), 50.0)), "6 × 5 pixels, smaller .*2 mrad"),
}
PNG = {
    "text": (lambda path: path.write_text("contrast,level\n"), "starts with.*PNG"),
    "truncated": (truncate, "truncated"),
    "flipped": (flip_middle, "damaged"),
    "declares 60000": (holding(png(60_000, 60_000, png_chunk(b"IDAT", zeros_deflated(1)))), "60000.*32768"),
    "400 MB of pixels": (holding(png(20_000, 20_000, png_chunk(b"IDAT", zeros_deflated(382)))), r"\d MB.*256"),
    "lacks rows": (holding(png(48, 48, png_chunk(b"IDAT", zlib.compress(bytes(49 * 20))))), EITHER_WAY),
}


@pytest.mark.parametrize(
    ("suffix", "spoil", "wanted"),
    [
        pytest.param(suffix, *case, id=f"{suffix} {label}")
        for suffix, cases in ((".exr", EXR), (".png", PNG))
        for label, case in cases.items()
    ],
)
def test_bad_frame(suffix, spoil, wanted, make_dataset):
    dataset = make_dataset(suffix=suffix)
    spoil(dataset.frame(BAD))
    assert_spoils(dataset, BAD, (re.escape(str(dataset.frame(BAD))), wanted), FrameError)


def assert_skipped(dataset, bad, wanted, todframes):
    """`--on-error skip` scores the rest, and lists the bad rows in JSON and on standard error."""
    status, out, errors = todframes("score", dataset.path, "--on-error", "skip", "--json", "--set", "resamples=0")
    assert status == 0, errors
    result = json.loads(out)
    assert [one["frame"] for one in result["skipped"]] == [dataset.rows[row]["frame"] for row in bad]
    for one in result["skipped"]:
        assert_says(one["error"], wanted)
        assert "\n" not in one["error"]
        assert f"skipped: {one['error']}" in errors
    assert sum(fit["n_trials"] for fit in result["fits"]) == len(dataset.rows) - len(bad)
    assert len([line for line in errors if not line.startswith("note: ")]) == len(bad)


def assert_validate_finds(dataset, problems, todframes):
    """A line a problem, in any order, then how many there are."""
    status, out, errors = todframes("validate", dataset.path)
    assert status == BAD_DATA
    assert out == ""
    assert len(errors) == len(problems) + 1, errors
    for wanted in problems:
        assert any(all(re.search(pattern, line) for pattern in wanted) for line in errors[:-1]), (wanted, errors)
    assert_says(errors[-1], (re.escape(str(dataset.path)), rf"\b{len(problems)} problem"))


@pytest.mark.parametrize("spoil", [Path.unlink, replaced_by_folder, replaced_by_pipe], ids=lambda f: f.__name__)
def test_checksum_of_what_is_no_file(spoil, make_dataset, fails):
    """A pipe that nobody writes to must not be waited for."""
    dataset = make_dataset(row_changes={BAD: {"sha256": "0" * 64}})
    spoil(dataset.frame(BAD))
    signal.signal(signal.SIGALRM, lambda *_: pytest.fail("waits for the pipe"))
    signal.alarm(2)
    try:
        fails("score", dataset.path, status=BAD_DATA, wanted=(re.escape(str(dataset.frame(BAD))),))
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, signal.SIG_DFL)


def test_text_bomb_in_a_png_is_not_inflated(make_dataset, todframes):
    """Comments of 400 MB in 400 kB: read without them, or refused in a line."""
    from resource import RUSAGE_SELF, getrusage

    dataset = make_dataset(suffix=".png")
    bomb = png_chunk(b"zTXt", b"Comment\0\0" + zeros_deflated(400))
    pixels = png_chunk(b"IDAT", zlib.compress((b"\0" + bytes([128] * 48)) * 48))
    dataset.frame(BAD).write_bytes(png(48, 48, bomb, pixels))
    before_kib = getrusage(RUSAGE_SELF).ru_maxrss
    status, _, errors = todframes("score", dataset.path, "--json", "--quiet")
    assert getrusage(RUSAGE_SELF).ru_maxrss < before_kib + 200 * 1024
    assert (status, errors) == (0, []) or (status == BAD_DATA and len(errors) == 1), errors


@pytest.mark.parametrize("line", ["score", "score --locate", "compare --enhance median"])
def test_no_good_row(line, make_dataset, fails):
    dataset = make_dataset(contrasts=(0.5,))
    for row in dataset.rows:
        row["orientation"] = "north"
    dataset.save()
    command, *options = line.split()
    wanted = (re.escape(str(dataset.path)), "no frame can be scored; the first: ", "line 2", "'north'")
    fails(command, dataset.path, *options, "--on-error", "skip", status=BAD_DATA, wanted=wanted)


def test_validate_lists_all_problems(make_dataset, todframes):
    dataset = make_dataset(row_changes={0: {"orientation": "north"}, 3: {"size_mrad": "-1"}})
    dataset.frame(1).unlink()
    truncate(dataset.frame(2))
    frames = [(re.escape(str(dataset.frame(row))),) for row in (1, 2)]
    assert_validate_finds(dataset, [("line 2", "north"), ("line 5", "size_mrad"), *frames], todframes)


def test_validate_looks_at_all_frames_of_a_trial_with_a_bad_row(make_dataset, todframes):
    dataset = make_dataset(repeats=2, row_changes={BAD: {"orientation": "north"}})
    for number, row in enumerate(dataset.rows):
        row["trial"] = f"trial {number // 2}"
    dataset.save()
    dataset.frame(0).unlink()
    missing = (re.escape(str(dataset.frame(0))), "No such file")
    assert_validate_finds(dataset, [(BAD_LINE, "north"), missing], todframes)


ROWS = {
    "orientation unknown": ({"orientation": "north"}, ("orientation", "'north'", "up, right, down or left")),
    "orientation in capitals": ({"orientation": "Up"}, ("found 'Up', expected up, .*; write up$",)),
    "size zero": ({"size_mrad": "0"}, ("size_mrad", "'0'", "> 0")),
    "size with decimal comma": ({"size_mrad": "2,0"}, ("size_mrad", "'2,0', .* with a point, not a comma")),
    "level zero": ({"contrast": "0"}, ("contrast", "'0'", "> 0")),
    "polarity": ({"polarity": "0"}, ("polarity", "'0'", "1 or -1")),
    "x text": ({"x_px": "left", "y_px": "3"}, ("x_px", "'left'", "number")),
    "y missing": ({"x_px": "3", "y_px": ""}, ("x_px and y_px", "both or none")),
    "path upwards": ({"frame": "../secret.exr"}, (r"\.\./secret\.exr", "outside")),
    "path absolute": ({"frame": "/secret.exr"}, ("/secret.exr", "outside")),
    "path with backslashes": ({"frame": r"frames\a.exr"}, (r"backslashes, expected slashes: frames/a\.exr$",)),
    "path empty": ({"frame": ""}, ("frame", "''", "path")),
    "path with nul": ({"frame": "frames/a\0.exr"}, ("frame", r"\\x00", "path")),
}


@pytest.mark.parametrize(("changes", "wanted"), ROWS.values(), ids=ROWS.keys())
def test_bad_row(changes, wanted, make_dataset):
    dataset = make_dataset(row_changes={BAD: changes})
    assert_spoils(dataset, BAD, (re.escape(str(dataset.manifest_file)), BAD_LINE, *wanted))


def test_bad_row_meets_the_commands(make_dataset, fails, todframes, tmp_path):
    dataset = make_dataset(row_changes={BAD: {"size_mrad": "-1"}})
    wanted = (re.escape(str(dataset.manifest_file)), BAD_LINE, "size_mrad", "'-1'", "> 0")
    fails("score", dataset.path, "-o", tmp_path / "out", status=BAD_DATA, wanted=wanted)
    assert_skipped(dataset, [BAD], wanted, todframes)
    assert_validate_finds(dataset, [wanted], todframes)


# What is wrong with a row only shows on the frame: the line names the frame.
AT_THE_FRAME = {
    "sha256": ({"sha256": "0" * 64}, "sha256.*0{64}.*[1-9a-f]|sha256.*[1-9a-f].*0{64}"),
    "off to the left": ({"x_px": "1", "y_px": "23"}, "off the frame"),
    "far off": ({"x_px": "1e300", "y_px": "-1e300"}, "off the frame"),
    "link to itself": ({"frame": "loop.exr"}, r"loop\.exr"),
    "too large": ({"size_mrad": "1e308"}, "48 × 48 pixels.*smaller than the triangle"),
}


@pytest.mark.parametrize(("changes", "wanted"), AT_THE_FRAME.values(), ids=AT_THE_FRAME.keys())
def test_bad_row_that_shows_on_the_frame(changes, wanted, make_dataset):
    dataset = make_dataset(row_changes={BAD: changes})
    (dataset.path / "loop.exr").symlink_to("loop.exr")
    assert_spoils(dataset, BAD, (re.escape(str(dataset.frame(BAD))), wanted), FrameError)


@pytest.mark.parametrize("background", ["0", "-50", "", "nan", "dark", "1e-320"])
def test_background_column(background, make_dataset):
    """Where the contrast overflows, as above a background of next to zero, the line names the frame."""
    dataset = make_dataset(display={"background_luminance_cd_m2": "column"})
    for row in dataset.rows:
        row["background_luminance_cd_m2"] = "50"
    dataset.rows[BAD]["background_luminance_cd_m2"] = background
    dataset.save()
    if background == "1e-320":
        wanted = (re.escape(str(dataset.frame(BAD))), "background|luminance|contrast")
        assert_spoils(dataset, BAD, wanted, FrameError)
    else:
        assert_spoils(dataset, BAD, (BAD_LINE, "background_luminance_cd_m2", f"'{background}'", "> 0"))


@pytest.mark.parametrize("change", [{"contrast": "1e308"}, {"contrast": "1e-308"}, {"size_mrad": "5e-324"}])
def test_values_near_the_ends_of_all_numbers_print_nothing(change, make_dataset, todframes):
    """What the frames show is measured with numbers that can be squared and divided by: NumPy does not warn."""
    dataset = make_dataset(contrasts=(0.05, 0.1, 0.5), repeats=2, row_changes={23: change})
    status, out, errors = todframes("score", dataset.path, "--json", "--quiet", "--set", "resamples=0")
    assert (status, errors) == (0, [])
    assert sum(fit["n_trials"] for fit in json.loads(out)["fits"]) == 24


@pytest.mark.parametrize("frame", ["link.exr", "link/secret.exr"])
def test_link_out_of_the_dataset(frame, make_dataset, tmp_path):
    dataset = make_dataset(row_changes={BAD: {"frame": frame}})
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    shutil.copy(dataset.frame(0), elsewhere / "secret.exr")
    (dataset.path / "link.exr").symlink_to(elsewhere / "secret.exr")
    (dataset.path / "link").symlink_to(elsewhere)
    assert_spoils(dataset, BAD, (BAD_LINE, "link", "outside"))


@pytest.mark.parametrize("spelling", ["frames/{}", "./frames/{}", "frames//{}", "frames/../frames/{}"])
def test_duplicate_row(spelling, make_dataset):
    """The row that repeats is the bad one; the first stays."""
    dataset = make_dataset()
    name = dataset.frame(BAD).name
    dataset.rows.append(dataset.rows[BAD] | {"frame": spelling.format(name)})
    dataset.save()
    assert_spoils(dataset, 8, (re.escape(str(dataset.manifest_file)), "line 10", re.escape(name), BAD_LINE))


HEADER = "frame,orientation,size_mrad,contrast"
MANIFESTS = {
    "empty": (b"", ("column 'frame' is missing",)),
    "header only": (HEADER.encode(), ("no frames", "row")),
    "no header": (b"frames/a.exr,up,2.0,0.5\n", ("column 'frame' is missing", "found frames/a.exr, up")),
    "background for scene": (f"{HEADER},background\na.exr,up,2,1,b\n".encode(), ("write scene",)),
    "misspelt": (f"{HEADER},Polarity\na.exr,up,2,1,1\n".encode(), ("write polarity",)),
    "level column missing": (b"frame,orientation,size_mrad\na.exr,up,2\n", ("column 'contrast' is missing",)),
    "semicolons": (HEADER.replace(",", ";").encode() + b"\na.exr;up;2;1\n", ("semicolons .*expected commas",)),
    "capitals": (HEADER.title().encode() + b"\na.exr,up,2,1\n", ("missing; .*write frame, not Frame$",)),
    "x without y": (f"{HEADER},x_px\na.exr,up,2,1,3\n".encode(), ("x_px and y_px", "both or none")),
    "column twice": (f"{HEADER},orientation\na.exr,up,2,1,left\n".encode(), ("'orientation'", "2 times")),
    "latin-1": (f"{HEADER}\nfrämes/a.exr,up,2,1\n".encode("latin-1"), ("not UTF-8", r"byte 39")),
    "quote never closed": (f'{HEADER}\n"a.exr,up,2,1\n'.encode(), ("line 2", "not valid CSV")),
    "huge field": (f"{HEADER}\n{'a' * 200_000},up,2,1\n".encode(), ("line 2", "not valid CSV")),
}  # fmt: skip


@pytest.mark.skipif(sys.platform != "linux", reason="Linux lists open files")
def test_a_file_that_is_no_csv_is_closed(tmp_path):
    """As soon as it is refused: the traceback, which may be kept, does not hold it open."""
    (tmp_path / "rows.csv").write_bytes(b"a" * 200_000)
    with pytest.raises(DataError, match="not valid CSV") as caught:
        list(read_csv(tmp_path / "rows.csv"))
    assert caught.tb is not None
    assert str(tmp_path / "rows.csv") not in {os.path.realpath(one) for one in Path("/proc/self/fd").iterdir()}


@pytest.mark.parametrize("fields", ["frames/x.exr,up,2", "frames/x.exr,up,2,0.5,0.5", "frames/x.exr"])
def test_fields_of_a_row(fields, make_dataset):
    dataset = make_dataset()
    lines = dataset.manifest_file.read_text().splitlines()
    lines[1 + BAD] = fields
    dataset.manifest_file.write_text("\n".join(lines))
    dataset.rows[BAD]["frame"] = "frames/x.exr"
    wanted = (re.escape(str(dataset.manifest_file)), BAD_LINE, "fields", str(len(fields.split(","))), "4")
    assert_spoils(dataset, BAD, wanted)


def test_line_break_in_a_name_stays_in_its_line(make_dataset, fails, todframes):
    dataset = make_dataset(row_changes={BAD: {"frame": "frames/a\nb.exr"}})
    fails("score", dataset.path, status=BAD_DATA, wanted=("a.?.?.?b.exr", "No such file"))
    assert_validate_finds(dataset, [("No such file",)], todframes)
    status, _, errors = todframes("score", dataset.path, "--on-error", "skip", "--json")
    assert (status, len(errors)) == (0, 1), errors


@pytest.mark.parametrize("name", ["missing", "file", "file/below"])
def test_dataset_is_no_folder(name, tmp_path):
    (tmp_path / "file").write_text("")
    with refused(DataError, (re.escape(str(tmp_path / name)), "not a folder", "dataset.toml")):
        load_dataset(tmp_path / name)


@pytest.mark.parametrize("url", ["s3://key:hidden@lab/archive", "https://host/archive?hidden", "file:///archive"])
@pytest.mark.parametrize("command", ["score", "validate", "compare --enhance clahe"])
def test_a_url_is_no_dataset(command, url, todframes):
    status, out, (err,) = todframes(*command.split(), url)
    assert (status, out) == (1, "") and "found a URL, expected a folder; mount it" in err and "hidden" not in err


SECRET = "root:x:0:0,secret\n"
NO_SECRET = "^(?!.*root:x)"
OF_PIPE = "is a pipe or device, expected a file; save what comes from it to a file first"


def as_endless_device(path):
    path.unlink()
    path.symlink_to("/dev/zero")


def as_link(path):
    """To a file of somebody else."""
    path.unlink()
    secret = path.parent.parent / "passwd"
    secret.write_text(SECRET)
    path.symlink_to(secret)


@pytest.mark.parametrize(
    ("spoil", "wanted"),
    [(replaced_by_pipe, "is a pipe or device, expected a"), (as_endless_device, "outside"), (as_link, "outside")],
)
@pytest.mark.parametrize("name", ["dataset.toml", "manifest.csv", "lut.csv"])
def test_files_of_a_dataset(name, spoil, wanted, make_dataset):
    """A pipe would be waited for, a device read for ever, and a message might show a stranger's file."""
    dataset = make_dataset(display={"eotf": "lut", "lut": "lut.csv", "white_luminance_cd_m2": None})
    (dataset.path / "lut.csv").write_text("code_value,luminance_cd_m2\n0,0\n1,100\n")
    spoil(dataset.path / name)
    kind = DataError if name == "manifest.csv" else SettingsError
    with refused(kind, (name.replace(".", r"\."), wanted, NO_SECRET)):
        load_dataset(dataset.path)


@pytest.mark.parametrize("name", ["../passwd", "{}/passwd", "/etc/passwd"])
def test_luminance_table_outside_of_the_dataset(name, make_dataset, tmp_path):
    (tmp_path / "passwd").write_text(SECRET)
    name = name.format(tmp_path)
    dataset = make_dataset(display={"eotf": "lut", "lut": name, "white_luminance_cd_m2": None})
    wanted = (re.escape(str(dataset.settings_file)), r"\[display\]: lut", re.escape(name), "outside", NO_SECRET)
    with refused(SettingsError, wanted):
        load_dataset(dataset.path)


def test_paths_of_the_dataset_itself(make_dataset, todframes, tmp_path):
    """An absolute path and a link are as good as any other if they lead to a file of the dataset."""
    dataset = make_dataset(display={"eotf": "lut", "lut": "lut.csv", "white_luminance_cd_m2": None}, suffix=".png")
    (dataset.path / "table.csv").write_text("code_value,luminance_cd_m2\n0,0\n1,100\n")
    (dataset.path / "lut.csv").symlink_to("table.csv")
    (dataset.path / "link").symlink_to("frames")
    (tmp_path / "other").symlink_to(dataset.path)
    dataset.rows[0]["frame"] = str(dataset.frame(0))
    dataset.rows[1]["frame"] = str(tmp_path / "other" / dataset.rows[1]["frame"])
    dataset.rows[2]["frame"] = dataset.rows[2]["frame"].replace("frames", "link")
    dataset.save()
    for path in (dataset.path, tmp_path / "other"):
        status, _, errors = todframes("validate", path)
        assert (status, errors) == (0, [])
        status, _, errors = todframes("score", path)
        assert (status, errors) == (0, [])


@pytest.mark.parametrize("path", ["pipe", "/dev/zero", "/dev/null"])
def test_what_is_no_file(path, fails, tmp_path):
    os.mkfifo(tmp_path / "pipe")
    path = tmp_path / path
    wanted = (re.escape(str(path)), OF_PIPE)
    fails("fit", path, status=BAD_DATA, wanted=wanted)
    fails("score", "x", "--observer-settings", path, status=BAD_SETTINGS, wanted=wanted)


def test_pipe_on_standard_input():
    done = process("fit", "/dev/stdin", input="level,n_correct,n_trials\n1,10,40\n")
    assert done.returncode == BAD_DATA
    assert done.stderr == f"error: /dev/stdin: {OF_PIPE}\n"


def test_files_that_are_too_long(fails, tmp_path):
    with (tmp_path / "long").open("wb") as file:
        file.truncate(2**40)  # a hole that takes no space
    fails("fit", tmp_path / "long", status=BAD_DATA, wanted=("long: is longer than 256 MB",))
    wanted = ("long: is longer than 1 MB",)
    fails("score", "x", "--observer-settings", tmp_path / "long", status=BAD_SETTINGS, wanted=wanted)


def test_bad_rows_have_a_limit(fails, make_dataset):
    made = make_dataset()
    made.manifest_file.write_text("frame,orientation,size_mrad,contrast\n" + "x\n" * 200_000)
    fails("score", made.path, "--on-error", "skip", status=BAD_DATA, wanted=("found more than 100000 bad rows",))


DISPLAYS = {
    "unknown key": ({"pixel_pich_mrad": 1.0}, ("'pixel_pich_mrad'", "'pixel_pitch_mrad'")),
    "key in another case": ({"EOTF": "srgb"}, ("'EOTF'", "'eotf'")),
    "eotf missing": ({"eotf": None}, ("eotf", "missing")),
    "white missing": ({"white_luminance_cd_m2": None}, ("white_luminance_cd_m2", "missing")),
    "white true": ({"white_luminance_cd_m2": True}, ("white_luminance_cd_m2", "True|true")),
    "background missing": ({"background_luminance_cd_m2": None}, ("background_luminance_cd_m2", "missing")),
    "background in quotes": ({"background_luminance_cd_m2": "50"}, ("write 50 without quotation marks",)),
    "lut not used": ({"lut": "lut.csv"}, ("lut", "not used|no such file")),
    "lut number": ({"eotf": "lut", "lut": 7}, ("lut", "found 7", "text|path|name|str")),
    "lut file missing": ({"eotf": "lut", "lut": "nowhere.csv"}, (r"nowhere\.csv", "no such file")),
    "lut with nul": ({"eotf": "lut", "lut": "a\0.csv"}, ("lut", r"x00|u0000|NUL")),
}  # fmt: skip


EXPERIMENTS = {
    "level missing": ({"level": None}, ("level", "missing")),
    "level empty": ({"level": ""}, ("level", "''", "column")),
    "group_by text": ({"group_by": "size_mrad"}, ("group_by", "'size_mrad'")),
    "group_by of numbers": ({"group_by": [1]}, ("group_by", "found 1, expected text")),
    "group_by twice": (
        {"group_by": ["lens", "size_mrad", "lens"]},
        ("found lens, size_mrad, lens, expected each",),
    ),
    "group_by the level": ({"group_by": ["contrast"]}, ("group_by: found 'contrast', which is the level",)),
    "unknown key": ({"groupby": []}, ("'groupby'", "'group_by'")),
}


@pytest.mark.parametrize(
    ("table", "changes", "wanted"),
    [
        pytest.param(table, *case, id=f"{table}: {label}")
        for table, cases in (("display", DISPLAYS), ("experiment", EXPERIMENTS))
        for label, case in cases.items()
    ],
)
def test_bad_table(table, changes, wanted, make_dataset):
    dataset = make_dataset(contrasts=(0.5,), **{table: changes})
    # A message about the luminance table names that file.
    place = rf"{re.escape(str(dataset.path))}.*" + (r"\[experiment\]" if table == "experiment" else "")
    with refused(SettingsError, (place, *wanted)):
        load_dataset(dataset.path)


COLUMNS = {
    "snr": {"experiment": {"level": "snr"}},
    "lens": {"experiment": {"group_by": ["lens"]}},
    "background_luminance_cd_m2": {"display": {"background_luminance_cd_m2": "column"}},
}


@pytest.mark.parametrize(("name", "tables"), COLUMNS.items(), ids=COLUMNS.keys())
def test_columns_that_the_settings_name_are_missing(name, tables, make_dataset):
    dataset = make_dataset(contrasts=(0.5,), **tables)
    with refused(DataError, (re.escape(str(dataset.manifest_file)), f"column '{name}' is missing")):
        load_dataset(dataset.path)


DISPLAY_TABLE = (
    "[display]\neotf = 'linear'\nwhite_luminance_cd_m2 = 1.0\npixel_pitch_mrad = 0.25\n"
    "background_luminance_cd_m2 = 50.0\n"
)
EXPERIMENT_TABLE = "[experiment]\nlevel = 'contrast'\n"
WHOLE = "schema = 1\n" + DISPLAY_TABLE + EXPERIMENT_TABLE
TOML = {
    "missing": (None, ("no such file",)),
    "empty": (b"", ("schema", "None|missing", "1")),
    "schema missing": ((DISPLAY_TABLE + EXPERIMENT_TABLE).encode(), ("schema", "None|missing", "1")),
    "schema 2": (b"schema = 2\n[display]\n[experiment]\n", ("schema", "found 2", "expected 1")),
    "no display": (("schema = 1\n" + EXPERIMENT_TABLE).encode(), (r"\[display\]", "missing")),
    "no experiment": (("schema = 1\n" + DISPLAY_TABLE).encode(), (r"\[experiment\]", "missing")),
    "unknown table": (b"schema = 1\n[dispaly]\n", ("'dispaly'", "'display'")),
    "unknown top key": (b"schema = 1\nlevl = 1\n", ("'levl'",)),
    "syntax": (b"schema = 1\n[display\n", ("not valid TOML", "line 2")),
    "date for a number": (WHOLE.replace("0.25", "2001-01-01").encode(), ("pixel_pitch_mrad", "2001")),
    "huge whole number": (WHOLE.replace("0.25", "1" + "0" * 400).encode(), ("pixel_pitch_mrad",)),
    "nested lists": (b"schema = 1\nx = " + b"[" * 2000 + b"]" * 2000, ("not valid TOML", "nested too deep")),
    "5,000 digits": (b"schema = " + b"9" * 5000 + b"\n", ("not valid TOML", "whole number", "digits")),
    "long key": (b"k" * 900_000 + b" = 1\n", ("unknown key 'kkk", "…")),
    "long file": (b"# " + b"x" * 2**20 + b"\n", ("longer than 1 MB",)),
}  # fmt: skip


# The table is part of the settings: all that is wrong in it has the same status.
TABLES = {
    "columns": (b"code,luminance\n0,0\n1,100\n", ("column", "code_value")),
    "text": (b"code_value,luminance_cd_m2\n0,dark\n1,100\n", ("line 2", "luminance_cd_m2", "'dark'", "number")),
    "one row": (b"code_value,luminance_cd_m2\n0,1\n", ("two rows or more",)),
}


@pytest.mark.parametrize(
    ("name", "kind", "content", "wanted"),
    [
        pytest.param(name, kind, *case, id=f"{name}: {label}")
        for name, kind, cases in (
            ("manifest.csv", DataError, MANIFESTS),
            ("dataset.toml", SettingsError, TOML),
            ("lut.csv", SettingsError, TABLES),
        )
        for label, case in cases.items()
    ],
)
def test_bad_file_of_a_dataset(name, kind, content, wanted, make_dataset):
    display = {"eotf": "lut", "lut": "lut.csv", "white_luminance_cd_m2": None} if name == "lut.csv" else {}
    path = make_dataset(contrasts=(0.5,), display=display).path
    if content is None:
        (path / name).unlink()
    else:
        (path / name).write_bytes(content)
    with refused(kind, (re.escape(str(path / name)), *wanted)):
        load_dataset(path)


ONE_MRAD = "naked-eye --size-mrad 1"
USAGES = {
    "unknown command": ("scroe x", ("scroe",)),
    "unknown option": ("score x --workes 2", ("--workes",)),
    "dataset not given": ("score", ("DATASET",)),
    "decisions": ("score x --decisions guessed", ("--decisions", "guessed", "expected", "sampled")),
    "seed negative": ("score x --seed -1", ("--seed", "-1")),
    "noise text": ("score x --internal-noise low", ("--internal-noise", "low")),
    "criterion above one": ("score x --p-correct 75", ("p_correct", "75")),
    "naked eye without either": ("naked-eye", ("--contrast", "--size-mrad")),
    "naked eye with both": ("naked-eye --contrast 1 --size-mrad 1", ("--contrast", "--size-mrad")),
    "contrast zero": ("naked-eye --contrast 0", ("contrast", "0", "> 0")),
    "contrast huge": ("naked-eye --contrast 1e160", ("contrast", r"1e\+160", "at most 1e12")),
    "sizes text": ("naked-eye --size-mrad 1,two", ("--size-mrad", "1,two", "commas")),
    "size negative after a good one": ("naked-eye --size-mrad 1,-1", ("size_mrad|--size-mrad", "-1", "> 0")),
    "size beyond the retina": ("naked-eye --size-mrad 1e6", ("size_mrad|--size-mrad|1e\\+06 mrad", "expected")),
    "size beyond all numbers": ("naked-eye --size-mrad 1e308", ("mrad", "expected")),
    "noise twice": (f"{ONE_MRAD} --set internal_noise_sd=0.1 --internal-noise 0.5", ("internal_noise_sd",)),
    "few levels": ("naked-eye --size-mrad 10 --set levels=2", ("levels",)),
    "far displacement": (f"{ONE_MRAD} --set position_jitter_samples=50", ("levels: found 4, .*displacement",)),
    "guess rate of a model": (f"{ONE_MRAD} --set guess_rate=0.5", ("guess_rate",)),
    "fit setting unknown": ("fit x --set gess_rate=0.5", ("'gess_rate'", "'guess_rate'")),
}


@pytest.mark.parametrize(("line", "wanted"), USAGES.values(), ids=USAGES.keys())
def test_bad_usage(line, wanted, fails):
    """Before any file is looked at: there is no dataset `x`."""
    fails(*line.split(), status=BAD_SETTINGS, wanted=wanted)


ASSIGNMENTS = {
    "unknown fit setting": ("lapserate=0.1", ("'lapserate'", "'lapse_rate'")),
    "without equals": ("kernel_a", ("--set", "kernel_a", "NAME=VALUE")),
    "without value": ("kernel_a=", ("kernel_a", "''", "float|number")),
    "date": ("internal_noise=2001-01-01", ("internal_noise", "2001")),
    "nested list": (f"levels={'[' * 2000}{']' * 2000}", ("levels", "whole number")),
    "5,000 digits": (f"levels={'9' * 5000}", ("levels", "whole number")),
    "long name": (f"{'k' * 100_000}=1", ("unknown key 'kkk", "…")),
    "centre": ("centre=middle", ("centre", "'middle'", "centroid", "bounding_box")),
    "noise nan": ("internal_noise=nan", ("internal_noise", "nan", "from 0 to")),
    "lapse rate": ("lapse_rate=0.9", ("lapse_rate", "0.9")),
    "guess rate": ("guess_rate=1", ("guess_rate", "found 1")),
    "criterion nan": ("p_correct=nan", ("p_correct", "nan")),
    "of another observer": ("efficiency=0.5", ("efficiency is a setting of csf; pyramid has none",)),
    "two in one": ("kernel_a=0.4\nband_gain=2", ("kernel_a",)),
    "no TOML list": ("band_noise=[.5,.5]", (r"band_noise=\[.5,.5\]", "a list as TOML has it")),
}


def asked(**options):
    return {"observer": "pyramid", "observer_settings": None, "internal_noise": None, "p_correct": None} | options


@pytest.mark.parametrize(("assignment", "wanted"), ASSIGNMENTS.values(), ids=ASSIGNMENTS.keys())
def test_bad_assignment(assignment, wanted):
    with refused(SettingsError, wanted):
        make_observers(asked(assignments=[assignment]))


def test_noise_of_an_observer_that_has_another_measure_of_it():
    with refused(SettingsError, ("internal_noise is a setting of .*pyramid", "csf has none; .* efficiency")):
        make_observers(asked(observer="csf", internal_noise=0.3, assignments=[]))


def test_out_of_memory(make_dataset, fails, tmp_path, monkeypatch):
    """As with retina_pitch_mrad = 1e-3, or levels = 12: a line that tells which kind of trouble it is."""

    def too_large(*_, **__):
        raise MemoryError("Unable to allocate 2.00 GiB for an array with shape (16385, 16385)")

    dataset = make_dataset(contrasts=(0.5,))
    monkeypatch.setattr("todframes.scoring.trial_scores.read_trial", too_large)
    fails("score", dataset.path, "-o", tmp_path / "out", status=BAD_DATA, wanted=("memory",))


def test_no_command_shows_the_help(todframes):
    status, out, errors = todframes()
    assert status in (0, BAD_SETTINGS)
    assert len(out.splitlines() or errors) > 5, "help in lines, not folded into one"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--observer-settings", "good.toml", "--set", "kernel_a=abc"), "settings: kernel_a: found 'abc'"),
        (("--observer-settings", "good.toml", "--set", "kernel_z=1"), "settings: unknown key 'kernel_z'"),
        (("--observer-settings", "bad.toml", "--set", "kernel_b=1"), "bad.toml: unknown key 'kernel_z'"),
        (("--set", "retina_pitch_mrad=0.0001"), "size_mrad: found 3 mrad at the eye, expected at most 0.2276"),
    ],
)
def test_a_message_names_what_was_given(arguments, message, fails, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("good.toml").write_text("kernel_a = 0.4\n")
    Path("bad.toml").write_text("kernel_z = 0.4\n")
    fails("naked-eye", "--size-mrad", "3", *arguments, status=BAD_SETTINGS, wanted=(f"^error: {message}",))


COUNTS = {
    "empty": (b"", ("column 'level' is missing",)),
    "header only": (b"level,n_correct,n_trials\n", ("no counts", "rows")),
    "column missing": (b"level,n_correct\n1,2\n", ("column 'n_trials' is missing", "level, n_correct")),
    "level zero": (b"level,n_correct,n_trials\n0,1,2\n", ("line 2", "level", "0", "> 0")),
    "more right than shown": (b"level,n_correct,n_trials\n1,3,2\n", ("line 2", "n_correct", "3", "n_trials")),
    "negative": (b"level,n_correct,n_trials\n1,-1,2\n", ("line 2", "n_correct", "-1", "0")),
    "no trials": (b"level,n_correct,n_trials\n1,0,0\n", ("line 2", "n_trials", "0", ">= 1")),
    "fraction": (b"level,n_correct,n_trials\n1,1.5,2\n", ("line 2", "n_correct", "1.5", "whole")),
    "proportion": (b"level,n_correct,n_trials\n1,0.5,0.7\n", ("line 2", "n_trials", "0.7", "whole")),
    "beyond counting": (b"level,n_correct,n_trials\n1,1,1e300\n", ("line 2", "n_trials", "1e\\+?300")),
}


@pytest.mark.parametrize(("content", "wanted"), COUNTS.values(), ids=COUNTS.keys())
def test_bad_counts(content, wanted, tmp_path):
    path = tmp_path / "counts.csv"
    path.write_bytes(content)
    with refused(DataError, (re.escape(str(path)), *wanted)):
        read_counts(path)


@pytest.mark.parametrize("name", ["result.json", "scores.csv"])
def test_a_folder_in_the_way_of_a_result(name, make_dataset, todframes, tmp_path):
    """Whole or not at all: the files that are not in the way are not replaced either."""
    out = tmp_path / "out"
    (out / name).mkdir(parents=True)
    (out / name / "mine").write_text("mine")
    before = tree(tmp_path)
    dataset = make_dataset()
    status, _, (error, note) = todframes("score", dataset.path, "-o", out)
    assert status == BAD_SETTINGS
    assert_says(error, (re.escape(str(out)), re.escape(name)))
    assert note.startswith(f"note: what is finished is kept in {out}; ")
    shutil.rmtree(out / ".todframes-staging")
    assert {path for path in tree(tmp_path) if dataset.path not in (path, *path.parents)} == set(before)


def test_disk_full(make_dataset, fails, tmp_path, monkeypatch):
    def no_space(_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(output.os, "fsync", no_space)
    fails("score", make_dataset().path, "-o", tmp_path / "out", kept=tmp_path / "out",
          status=BAD_SETTINGS, wanted=(re.escape(str(tmp_path / "out")), "No space left"))  # fmt: skip


def test_an_interruption_says_that_results_were_written(make_dataset, todframes, tmp_path, monkeypatch):
    """As where Ctrl-C comes while the table is printed; of the run after it nothing was written."""

    def interrupted(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr("todframes.cli.runner.print_result", interrupted)
    out, dataset = tmp_path / "out", make_dataset()
    status, _, errors = todframes("score", dataset.path, "-o", out)
    assert (status, errors) == (INTERRUPTED, [f"error: interrupted, but {out} was written before"])
    assert (out / "result.json").is_file()
    status, _, errors = todframes("score", dataset.path)
    assert (status, errors) == (INTERRUPTED, ["error: interrupted, nothing was written"])


@pytest.mark.parametrize("options", ["", "--locate", "--quiet"])
def test_one_json_object_whatever_is_remarked(options, make_dataset, todframes):
    # A strong triangle, so that --locate finds it; and luminance below zero, which is remarked on.
    dataset = make_dataset(contrasts=(1.0, 2.0))
    dataset.frame(BAD).write_bytes(b"")
    pixels = np.full((48, 48), 50.0)
    pixels[20, 20] = -1.0
    write_frame(dataset.frame(2), pixels)
    status, out, errors = todframes("score", dataset.path, "--on-error", "skip", "--json", *options.split())
    assert status == 0, errors
    assert json.loads(out)["skipped"][0]["frame"] == dataset.rows[BAD]["frame"]
    assert out.rstrip("\n").endswith("}")
    assert bool(errors) == ("--quiet" not in options)


HOSTILE = "\x1b]0;title\x07\x1b[31mred\x7f\x9b2J\u202eabc\u2066"
SHOWN = r"\x1b]0;title\x07\x1b[31mred\x7f\x9b2J\u202eabc\u2066"
"""Sets a terminal's title and colour, clears it and turns the direction of text; and how it is shown."""


def test_terminals_are_left_alone(make_dataset, todframes, tmp_path):
    """By names and values of data, on both streams."""
    dataset = make_dataset(f"set {HOSTILE}", experiment={"group_by": [f"column {HOSTILE}"]})
    for row in dataset.rows:
        row[f"column {HOSTILE}"] = f"value {HOSTILE} two\nlines"
    dataset.rows[0]["frame"] = f"frames/{HOSTILE}.exr"
    dataset.save()
    options = ("--set", "resamples=0", "--on-error", "skip", "--explain", "-o", tmp_path / HOSTILE)
    status, out, errors = todframes("score", dataset.path, *options)
    assert status == 0, errors
    for line in (*out.splitlines(), *errors):
        assert line.isprintable(), line
    for shown in (f"set {SHOWN}: 7 trials", f"column {SHOWN}", rf"value {SHOWN} two\nlines", f"/{SHOWN}\n"):
        assert shown in out
    assert f"frames/{SHOWN}.exr" in errors[0]


@pytest.mark.parametrize(
    "arguments",
    [
        (HOSTILE,),
        ("score", HOSTILE),
        ("score", "x", "--decisions", HOSTILE),
        ("compare", "x", "--enhance", HOSTILE),
        ("fit", "folder\udcff"),
    ],
)
def test_arguments_are_shown_without_control_characters(arguments, todframes):
    status, out, errors = todframes(*arguments)
    assert (status != 0, out, len(errors)) == (True, "", 1)
    assert errors[0].isprintable(), errors


def process(*arguments, stdout=subprocess.PIPE, **options):
    how = {"stdout": stdout, "stderr": subprocess.PIPE, "text": True, "timeout": 60}
    return subprocess.run([*COMMAND, *map(str, arguments)], check=False, **how, **options)


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no device that is always full")
@pytest.mark.parametrize("option", [("--json",), ()], ids=["json", "table"])
@pytest.mark.slow
def test_standard_output_is_full(option):
    with Path("/dev/full").open("w") as full:
        done = process("enhancements", *option, stdout=full)
    assert done.returncode != 0
    assert len(done.stderr.splitlines()) == 1, done.stderr
    assert_says(done.stderr, ("No space left",))


@pytest.mark.skipif(sys.platform == "win32", reason="needs a POSIX shell")
@pytest.mark.parametrize(
    ("line", "status", "out", "error"),
    [
        ("{} score {} --json --quiet >&-", 1, "", "error: cannot write to standard output"),
        ("{} score {} 2>&-", 0, "size .*threshold", ""),
        ("{} score {} --tolerance 0 2>&-", BAD_SETTINGS, "", ""),
        ("MPLBACKEND=none {} score {} -o out", 0, "size .*threshold", ""),
        ("ulimit -n 16; {} score {} --workers 2 -o out", 1, "", r"error: --workers: .* could not start \(Too ma"),
    ],
)
@pytest.mark.slow
@pytest.mark.every_case
def test_odd_shells(line, status, out, error, make_dataset, tmp_path):
    dataset = make_dataset(suffix=".png").path
    parts = ([sys.executable, "-m", "todframes"], [str(dataset), "--set", "resamples=0"])
    shell, how = ["sh", "-c", line.format(*map(shlex.join, parts))], {"timeout": 60, "cwd": tmp_path}
    done = subprocess.run(shell, capture_output=True, text=True, check=False, **how)
    assert (done.returncode, len(done.stderr.splitlines())) == (status, 1 if error else 0), done.stderr
    assert re.search(out, done.stdout)
    assert re.search(error, done.stderr)
    assert (tmp_path / "out").exists() == (status == 0 and "-o out" in line)


@pytest.mark.parametrize(
    ("error", "message"),
    [
        (OSError(errno.EMFILE, "Too many open files", "a.exr"), "error: a.exr: Too many open files"),
        (OSError(errno.ENOMEM, "No memory"), "error: the system refused a call: No memory"),
    ],
)
def test_an_error_of_the_system_is_not_one_of_standard_output(error, message, todframes, monkeypatch):
    monkeypatch.setattr("todframes.frames.dataset.load_dataset", Mock(side_effect=error))
    assert todframes("score", "x") == (BAD_DATA, "", [message])


def test_reader_of_standard_output_is_gone():
    read_end, write_end = os.pipe()
    os.close(read_end)
    done = process("enhancements", stdout=write_end)
    os.close(write_end)
    assert done.stderr == ""


@pytest.mark.parametrize(
    "encoding", ["ascii", *(pytest.param(name, marks=pytest.mark.slow) for name in ("latin-1", "cp1252"))]
)
def test_standard_output_of_few_characters(encoding, tmp_path):
    """As in a Windows console, or where output goes to a file there."""
    counts = tmp_path / "counts.csv"
    counts.write_text("level,n_correct,n_trials\n1,10,40\n2,20,40\n4,39,40\n")
    done = process("fit", counts, env=os.environ | {"PYTHONIOENCODING": encoding}, encoding=encoding)
    assert (done.returncode, done.stderr) == (0, "")
    assert "threshold" in done.stdout
