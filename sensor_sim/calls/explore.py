"""The call `explore`: a page on which a sensor's parameters move."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from sensor_sim.chain.sensor import Sensor, sensor_of


def explore(
    sensor: Sensor | Path | str,
    *,
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
        If a setting is invalid, the server cannot listen there, or Starlette or uvicorn is not installed.
    """
    from todframes.web import check_installed

    sensor = sensor_of(sensor)
    check_installed("explore")
    from sensor_sim.explorer.routes import Explorer, shown
    from todframes.web.server import Launch, serve

    launch = Launch(host=host, port=port, open_browser=open_browser)
    serve(Explorer(shown(sensor)).app(), launch, tell=tell, warn=warn)
