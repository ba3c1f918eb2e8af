"""The call `explore`: a page on which a sensor's parameters move."""

from __future__ import annotations

from collections.abc import Callable

from sensor_sim.chain.sensor import Sensor, sensor_of
from todframes.base.reading import checked
from todframes.field.atmosphere import Atmosphere
from todframes.field.target import Target
from todframes.observers.interface import Observer
from todframes.parameters import NamedFile, ObserverName, Port, Probability, SensorFile, TargetFactor
from todframes.psychometrics.fit import FitSettings


@checked
def explore(
    sensor: Sensor | SensorFile,
    *,
    observer: ObserverName | Observer = "pyramid",
    p_correct: Probability = 0.75,
    target: Target | NamedFile | None = None,
    atmosphere: Atmosphere | NamedFile | None = None,
    k: TargetFactor | None = None,
    host: str = "127.0.0.1",
    port: Port = 0,
    open_browser: bool = True,
    tell: Callable[[str], None] = print,
    warn: Callable[[str], None] | None = None,
) -> None:
    """Open a page in the browser on which a sensor's parameters move, and its TOD curve with them.

    A server on this machine computes the numbers, and sends nothing elsewhere. Ctrl-C ends it.

    Parameters
    ----------
    sensor : Sensor or path
        File with optics, detector, noise, electronics and display of the sensor.
    observer : str or Observer
        Observer by name: pyramid, informative, csf or another that is registered; or MODULE:CLASS, a class of your
        own, whose code is run. It must be linear.

        Settings by which people differ move on the page, the others stay. An object is taken as well.
    p_correct : float
        Raw proportion correct at threshold, to begin with.
    target : Target or path, optional
        Target in the field, as for `todframes range`: the page shows probability against range, too.
    atmosphere : Atmosphere or path, optional
        Air to the target, which a target needs.
    k : float, optional
        The target is seen if a triangle of size / K is, in place of the target's own K.
    host : str
        Address or name of this machine to listen at.
    port : int
        Port to listen at. 0 is a free one.
    open_browser : bool
        Open the page in the browser. Otherwise print the address only.
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
    from sensor_sim.sweeps.goals import chosen_aim
    from todframes.web.server import open_listener, serve

    target_in_air = chosen_aim(target, atmosphere, k)
    explorer = Explorer(sensor, observer, p_correct=p_correct, target_in_air=target_in_air)
    explorer.check()
    listener = open_listener(host, port)
    serve(explorer.app(), listener, host=host, open_browser=open_browser, tell=tell, warn=warn)
