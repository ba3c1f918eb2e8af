"""The command `noise`: three-dimensional noise of a recording, or noise as EMVA 1288 defines it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from todframes.base.errors import SettingsError, flag_of
from todframes.cli.console import print_content, print_result, progress, staged

if TYPE_CHECKING:
    from todframes.results.result import Result

OF_EMVA = {"exposure_ms", "photons", "bits"}
OF_OTHERS = {"patches", "signal", "mk_per_count", "frames_per_second"}
"""Options of one kind of measurement."""


def noise(given: dict[str, Any], shown: dict[str, Any], out: str | None) -> None:
    """Measure the noise of recordings, and show it."""
    as_sensor, as_json = given.pop("sensor", False), shown.pop("json")
    if as_sensor and as_json:
        raise SettingsError("noise: found --sensor and --json, expected one of them")
    is_emva = bool({"descriptor", "dark"} & given.keys())
    for name in sorted(given.keys() & (OF_OTHERS if is_emva else OF_EMVA)):
        other = "is not used with EMVA 1288" if is_emva else "needs --dark, the dark frames"
        raise SettingsError(f"{flag_of(name)}: {other}")
    if "recording" not in given and not is_emva:
        raise SettingsError("noise: found no RECORDING, expected one, or --emva DESCRIPTOR")
    import todframes as tod

    with staged(out) as write:
        with progress("reading", quiet=shown["quiet"]) as advance:
            if is_emva:
                bright = given.pop("recording", ())
                result: Result[Any] = tod.emva_noise(bright=bright, progress=advance, **given)
            else:
                result = tod.noise(given.pop("recording"), progress=advance, **given)
        table = result.sensor_toml() if as_sensor else None
        write(result.files)
    if table is not None:
        print_content(table, result.warnings, **shown)
        return
    print_result(result, as_json=as_json, out=out, is_timed=False, **shown)
