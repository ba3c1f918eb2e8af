"""Commands are made of the descriptions of calls: the reader of these, and the options of each command."""

from __future__ import annotations

import inspect
import re
from importlib import import_module

import click
import pytest

from sensor_sim.cli import COMMANDS as SENSOR_COMMANDS
from sensor_sim.cli import cli as sensor_cli
from todframes import parameters
from todframes.cli.console import run
from todframes.cli.main import COMMANDS, cli
from todframes.cli.options import REQUIRED, read_call
from todframes.cli.runner import LOADING, Command, make_command

TABLE = (*COMMANDS.values(), *SENSOR_COMMANDS.values())
CALLS = sorted({LOADING, *(call for one in TABLE for call in (one.call, one.also) if call)})

OPTIONS = """
todframes accuracy: --scene --dataset --time --seed -o --json --quiet
todframes calibrate: ANSWERS DATASET -o --free --subject --include-flagged --observer --p-correct --set
    --observer-settings --seed --on-error --max-frame-mb --workers --strict --json --quiet
todframes chart: --for --distance-m --sizes-mrad --contrasts --delta-t-k --repeats --polarity --seed --name
    --marker-mm --markers --camera-page --width-px --height-px --display --pixel-pitch-mm --bits --eotf
    --gamma --white-luminance-cd-m2 --black-luminance-cd-m2 --background-luminance-cd-m2 --page-duration-s
    --paper --margin-mm --reflectances --paper-reflectance --black-reflectance --background-reflectance
    --plate-mm -o --quiet
todframes compare: CONDITIONS --enhance --by -o --white --allow-clipping --explain --verbose --json --quiet
    --strict --decisions --curve --plan --seed --locate --gaze --on-error --max-frame-mb --workers --cluster
    --restart --keep-store --observer --internal-noise --p-correct --set --observer-settings
todframes enhancements: --json
todframes experiment: DATASET -o --subject --method --trials --practice --practice-correct --break-every
    --time-limit --consent --contact --background --no-dither --include-flagged --seed --max-frame-mb --host
    --port --no-browser
todframes export-trials: DATASET -o --pixel-pitch-mm --viewing-distance-mm --gamma --photometer --trials
    --background --no-dither --seed --max-frame-mb --quiet
todframes fit: COUNTS -o --p-correct --set --seed --verbose --json
todframes import: RECORDINGS --chart --schedule -o --display --each --integration-time --steady --warm-up --range
    --bits --frames-per-second --ifov-mrad --level --max-frame-mb --restart --keep-store --quiet
todframes import-answers: FOLDER FILE --subject --response
todframes mtf: RECORDING -o --box --chart --display --bits --plane --max-frame-mb --strict --json --quiet
todframes naked-eye: --contrast --size-mrad -o --verbose --json --quiet --observer --internal-noise
    --p-correct --set --observer-settings
todframes new: DATASET --from --display --level
todframes noise: RECORDING -o --dark --emva --exposure-ms --photons --region --patch --chart --signal
    --mk-per-count --frames-per-second --bits --plane --max-frame-mb --sensor --strict --json --quiet
todframes range: RESULT --target --atmosphere -o --k --cycles --cycles-per-size --search-time --p --distance-m
    --group --magnification --seed --verbose --strict --json --quiet
todframes report: RESULT -o --title
todframes sample: OUT --exact
todframes scenes: BACKGROUNDS --size-mrad --contrast -o --trials --darker
    --blur-px --windows --frames --turns --dim --display --range --seed --max-frame-mb --quiet
todframes score: DATASET -o --tolerance --explain --verbose --json --quiet --strict --decisions --curve
    --plan --seed --locate --gaze --on-error --max-frame-mb --workers --cluster --restart --keep-store
    --relative-to --observer --internal-noise --p-correct --set --observer-settings
todframes stability: --json --markdown --quiet
todframes validate: DATASET --add-sha256 --max-frame-mb --strict --json
sensor-sim advise: SENSOR --tolerance --seed -o --json --quiet --observer --internal-noise --p-correct --set
    --observer-settings
sensor-sim camera: RECORDING --chart --edge --grey --dark --exposure-ms --pitch-mrad --frames-per-second
    --mk-per-count --bits --plane --max-frame-mb -o --json --quiet --strict
sensor-sim curve: SENSOR --size-detectors --size-mrad --luminance --tolerance --plan --seed -o
    --limit --contrast --delta-t-k --snr
    --explain --verbose --json --quiet --observer --internal-noise --p-correct --set --observer-settings
sensor-sim explore: SENSOR --target --atmosphere --k --observer --internal-noise --p-correct --set
    --observer-settings --host --port --no-browser
sensor-sim mrtd: SENSOR --frequency-nyquist --size-detectors --against --direction --lloyd-snr
    --ttp-delta-t-k --ttp-width-deg --tolerance --seed -o --json --quiet --observer --internal-noise
    --p-correct --set --observer-settings
sensor-sim mtf: SENSOR -o --json
sensor-sim new: --emva --thermal --preset --from --focal-length-mm --f-number --pitch-um --netd-mk
    --wavelength-um --exposure-ms --frames-per-second --luminance --name -o
sensor-sim simulate: SENSOR --size-detectors --size-mrad --snr --contrast --trials --motion --warm-up --seed
    -o --format --allow-clipping --stages --background --background-pixels --background-range --turns
    --workers --quiet --cluster --restart --keep-store
sensor-sim sweep: SENSOR --size-detectors --vary --design --sample --keep-fill-factor --couple-netd
    --minimise --maximise --acuity-snr --acuity-delta-t-mk --target --atmosphere --k --tolerance
    --plan --seed --workers -o --json --quiet --observer --internal-noise --p-correct --set
    --observer-settings --cluster --restart --keep-store
sensor-sim worth: RESULT SENSOR --limit --tolerance --seed -o --json --quiet --observer --internal-noise --set
    --observer-settings
"""
"""Arguments and options of each command; a command begins a line."""


def commands_of(group: click.Group) -> dict[str, click.Command]:
    context = click.Context(group)
    found = {name: group.get_command(context, name) for name in group.list_commands(context)}
    return {name: one for name, one in found.items() if one is not None}


GROUPS = {"todframes": commands_of(cli), "sensor-sim": commands_of(sensor_cli)}


def shown_name(parameter: click.Parameter) -> str:
    name = "-o" if "-o" in parameter.opts else parameter.opts[0]
    return name.upper() if isinstance(parameter, click.Argument) else name


def test_each_command_has_its_options() -> None:
    found = {
        f"{program} {name}": sorted(map(shown_name, command.params))
        for program, commands in GROUPS.items()
        for name, command in commands.items()
    }
    lines = [line.partition(": ") for line in OPTIONS.strip().replace("\n    ", " ").splitlines()]
    assert found == {name: sorted(names.split()) for name, _, names in lines}


@pytest.mark.parametrize("call", CALLS)
def test_a_call_is_read_as_python_reads_it(call: str) -> None:
    """By the source alone, and by the imported function: names, defaults and kinds of values."""
    module, _, name = call.partition(":")
    names = vars(import_module(module))
    expected = inspect.signature(names[name]).parameters
    found = read_call(call).parameters
    assert [*found] == [*expected]
    for parameter in found.values():
        of_python = expected[parameter.name]
        if of_python.default is inspect.Parameter.empty:
            assert parameter.default is REQUIRED
        elif not callable(of_python.default):
            assert parameter.default == of_python.default
        # A name that is one of `parameters` is that one in the module of the call, too.
        for word in re.findall(r"\w+", of_python.annotation):
            if hasattr(parameters, word) and word in names:
                assert names[word] is getattr(parameters, word), (call, word)
        assert parameter.text, f"{name}: {parameter.name} is not described"


MEASURED = '''
MOST = -3

def measured(
    recordings: Sequence[PathLike], reference: PathLike, n_frames: Count = 3, *, port: Port,
    sizes: float | Numbers = (1.0, 2.5), most: WholeNumber = MOST, limit: Count = MAX_FRAME_MB, gain: float = 2.0,
    kind: Literal["up", "down"] | None = None, dither: bool = True, is_wide: bool = False,
    boxes: Sequence[Box] = (), locate: Locate | bool = False, group: GroupValues = None, path: Path | None = None,
    progress: Progress | None = None,
):
    """Measure a recording
    of anything.

    Further words on `n_frames` and `that`.

    Parameters
    ----------
    recordings : sequence
        Files
        to read.

        This is for Python alone.
    reference : path
        A file beside `recordings`.
    n_frames, port : int
        A number.
    sizes, most, limit, gain
        Several.
    kind : str, optional
        Which way. Default: that of `n_frames`.
    dither : bool
        Show all. Otherwise show some of them.
    is_wide : bool
        Wider.
    boxes, locate, group, path
        A part.

    Returns
    -------
    int
        Nothing.
    """
'''


def test_a_command_is_what_the_source_of_its_call_says(tmp_path, monkeypatch) -> None:
    (tmp_path / "a_call.py").write_text(MEASURED, encoding="utf-8")
    monkeypatch.syspath_prepend(tmp_path)
    texts = {"files": "tables", "details": "all", "text": "End."}
    made = make_command("measured", Command("a_call:measured", "recordings reference", "json verbose", **texts))
    assert made.help.split("\n\n") == [
        *("Measure a recording of anything.", "Further words on --n-frames and `that`.", "End."),
        *(
            "RECORDING…: Files to read.",
            "REFERENCE: A file beside --recordings.",
            "Without -o nothing is written.",
        ),
    ]
    wide = [(one.opts, one.help, one.type.name, one.multiple, one.required) for one in made.params[2:]]
    assert wide == [
        (["-o", "--out"], "Folder for tables.", "text", False, False),
        (["--n-frames"], "A number.  [default: 3; x>=1]", "integer range", False, False),
        (["--port"], "A number.  [x>=0; x<=65535]", "integer range", False, True),
        (["--sizes"], "Several.  [default: 1,2.5]", "N[,N…]", False, False),
        (["--most"], "Several.  [default: -3]", "integer", False, False),
        (["--limit"], "Several.  [default: 256; x>=1]", "integer range", False, False),
        (["--gain"], "Several.  [default: 2]", "float", False, False),
        (["--for"], "Which way.  [default: that of --n-frames]", "choice", False, False),
        (["--no-dither"], "Show some of them.", "boolean", False, False),
        (["--is-wide"], "Wider.", "boolean", False, False),
        (["--box"], "A part; repeatable.", "X,Y,W,H", True, False),
        (["--locate"], "A part. Without a value: group.", "choice", False, False),
        (["--group"], "A part; repeatable.", "COLUMN=VALUE", True, False),
        (["--path"], "A part.", "path", False, False),
        (["--verbose"], "Also print all.", "boolean", False, False),
        (["--json"], "Print one JSON object on standard output.", "boolean", False, False),
    ]
    arguments = [(one.name, one.nargs, one.required, one.metavar) for one in made.params[:2]]
    assert arguments == [("recordings", -1, True, "RECORDING…"), ("reference", 1, True, "REFERENCE")]


def test_a_kind_that_no_command_line_can_write_is_an_error(tmp_path, monkeypatch) -> None:
    """Otherwise its option would be missing, and nobody would see it; so with a default that is not to be read."""
    source = 'def unwritten(judge: Observer | None = None, *, most: int = Most):\n    """Score."""\n'
    (tmp_path / "unwritten_call.py").write_text(source, encoding="utf-8")
    monkeypatch.syspath_prepend(tmp_path)
    read = read_call("unwritten_call:unwritten").parameters
    with pytest.raises(TypeError, match=r"unwritten: judge: a command line has no form for .*Observer \| None"):
        _ = read["judge"].value
    with pytest.raises(TypeError, match="unwritten: most: expected a literal, or a constant of the same"):
        _ = read["most"].value


@pytest.mark.parametrize(
    ("line", "name", "value"),
    [
        ("compare D --enhance none --gaze tracked,fixed", "gaze", ["tracked", "fixed"]),
        ("compare D --enhance none --enhance tv", "enhance", ("none", "tv")),
        ("compare D --enhance none --observer pyramid,csf", "observer", ["pyramid", "csf"]),
        ("score --locate D", "locate", "group"),
        ("score D --locate each", "locate", "each"),
        ("score D", "workers", None),
        ("mtf a.npy b.npy --box 1,2,3,4 --box 5,6,7,8", "boxes", ((1, 2, 3, 4), (5, 6, 7, 8))),
        ("noise a.npy --patch 1,2,3,4=0.5", "patches", (((1, 2, 3, 4), 0.5),)),
        ("noise --emva a.txt", "recording", ()),
        ("range R --target nato --atmosphere a.toml --group a=b", "group", (("a", "b"),)),
        ("experiment D -o A --no-dither", "dither", False),
        ("experiment D -o A", "dither", None),
        ("scenes skimage --size-mrad 1,2 --contrast 0.5 -o D", "size_mrad", [1.0, 2.0]),
        ("import a.mkv --range 2:5 -o D", "value_range", (2.0, 5.0)),
        ("chart --for print --distance-m 1 --sizes-mrad 1 --polarity -1 -o C", "polarity", -1),
    ],
)
def test_values_on_a_command_line(line: str, name: str, value: object) -> None:
    command, *arguments = line.split()
    found = GROUPS["todframes"][command].make_context(command, arguments).params[name]
    assert found == value


def test_a_mistyped_command_has_a_hint(capsys) -> None:
    assert run(cli, ["scor"]) == 2
    assert capsys.readouterr().err == "error: No such command 'scor'. Did you mean 'score'?\n"
    assert run(sensor_cli, ["xyz"]) == 2
    assert capsys.readouterr().err == "error: No such command 'xyz'.\n"
    assert run(cli, ["--", "--xyz"]) == 2
    assert capsys.readouterr().err == "error: No such option '--xyz'.\n"
