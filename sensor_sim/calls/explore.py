"""The call `explore`: a page on which a sensor's parameters move."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from sensor_sim.chain.sensor import Sensor, sensor_of
from todframes.observers.interface import Observer
from todframes.psychometrics.fit import FitSettings

if TYPE_CHECKING:
    from todframes.field.atmosphere import Atmosphere
    from todframes.field.target import Target


def explore(
    sensor: Sensor | Path | str,
    *,
    observer: str | Observer = "pyramid",
    p_correct: float = 0.75,
    target: Target | Path | str | None = None,
    atmosphere: Atmosphere | Path | str | None = None,
    k: float | None = None,
    host: str = "127.0.0.1",
    port: int = 0,
    open_browser: bool = True,
    tell: Callable[[str], None] = print,
    warn: Callable[[str], None] | None = None,
) -> None:
    """Serve a page on which a sensor's parameters move, and its TOD curve with them, as `sensor-sim explore` does.

    The call returns when Ctrl-C is pressed, or the process is asked to end.

    Parameters
    ----------
    sensor : Sensor or path
        Settings to begin with, or the path of a SENSOR.toml.
    observer : str or Observer
        Name of a registered observer, "module:Class", or an observer; it must be linear. Settings by which people
        differ move on the page, the others stay.
    p_correct : float
        Raw proportion correct at threshold, to begin with.
    target : Target or path, optional
        Target in the field, as for `todframes.acquisition_range`: the page shows probability against range too.
    atmosphere : Atmosphere or path, optional
        Air to the target, which a target needs.
    k : float, optional
        In place of the target's k: the target is seen if a triangle of size / k is.
    host, port : str, int
        Address or name of this machine to listen at; port 0 is a free one.
    open_browser : bool
        Whether to open the page in the browser.
    tell : function of a text
        Called with the address of the page when the server listens. Nobody can open the page without this address.
    warn : function of a text, optional
        Called with a remark if other machines can reach the server.

    Raises
    ------
    SettingsError
        If a setting is invalid, the observer is not linear, the server cannot listen there, or Starlette or
        uvicorn is not installed.
    """
    from todframes.web import check_installed

    FitSettings(p_correct=p_correct)  # checks it
    sensor = sensor_of(sensor)
    check_installed("explore")
    from sensor_sim.explorer.routes import Explorer
    from sensor_sim.sweeps.ranges import chosen_aim
    from todframes.web.server import Launch, serve

    aim = chosen_aim(target, atmosphere, k)
    launch = Launch(host=host, port=port, open_browser=open_browser)
    explorer = Explorer(sensor, observer, p_correct=p_correct, aim=aim)
    explorer.check()
    serve(explorer.app(), launch, tell=tell, warn=warn)
