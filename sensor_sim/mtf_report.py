"""A sensor's transfer functions as an object, a table and a picture."""

from __future__ import annotations

import csv
import io
from typing import TYPE_CHECKING

import numpy as np

from sensor_sim.sensor import Sensor
from sensor_sim.transfer import stages
from todframes import __version__
from todframes._typing import Json
from todframes.report.tables import add_row, new_table

if TYPE_CHECKING:
    from rich.table import Table


POINTS = 201


TABLE_STEP = 20


def mtf_object(sensor: Sensor) -> Json:
    """Transfer of every stage along x at frequencies up to where optics or display pass nothing, as JSON."""
    cut_off, nyquist = sensor.optics.cut_off_cyc_per_mrad, sensor.detector.nyquist_cyc_per_mrad
    frequency = np.linspace(0.0, min(1.05 * cut_off, 10.0 * nyquist), POINTS)
    return {
        "schema": 1,
        "command": "mtf",
        "version": __version__,
        "sensor": sensor.name,
        "cut_off_cyc_per_mrad": cut_off,
        "nyquist_cyc_per_mrad": nyquist,
        "frequency_cyc_per_mrad": frequency.tolist(),
        "mtf": {name: values.tolist() for name, values in stages(frequency, sensor=sensor).items()},
    }


def mtf_table(result: Json) -> Table:
    """Every twentieth frequency, as a table for the terminal."""
    cut_off, nyquist = result["cut_off_cyc_per_mrad"], result["nyquist_cyc_per_mrad"]
    title = f"{result['sensor']}: MTF along x; optics' cut-off {cut_off:.4g}, Nyquist {nyquist:.4g} cycles/mrad"
    table = new_table(title, ("cycles/mrad", *result["mtf"]))
    for n in range(0, POINTS, TABLE_STEP):
        values = [f"{stage[n]:.4f}" for stage in result["mtf"].values()]
        add_row(table, [f"{result['frequency_cyc_per_mrad'][n]:.4g}", *values])
    return table


def mtf_files(result: Json) -> dict[str, bytes]:
    """All frequencies as CSV, and a picture with cut-off and Nyquist frequency marked."""
    from matplotlib.figure import Figure

    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["frequency_cyc_per_mrad", *result["mtf"]])
    writer.writerows(zip(result["frequency_cyc_per_mrad"], *result["mtf"].values(), strict=True))
    figure = Figure(figsize=(7.2, 4.8), layout="constrained")
    axes = figure.add_subplot()
    for name, values in result["mtf"].items():
        product = name.endswith("_sample")
        axes.plot(
            result["frequency_cyc_per_mrad"],
            values,
            label=name.replace("_", " "),
            lw=2.2 if product else 1.0,
            ls={"hold": "--", "display": ":", "electronics": "-."}.get(name, "-"),
            color={"pre_sample": "k", "post_sample": "0.5"}.get(name),
        )
    for name, style in (("cut_off", ":"), ("nyquist", "--")):
        place = result[f"{name}_cyc_per_mrad"]
        if place <= result["frequency_cyc_per_mrad"][-1]:
            axes.axvline(place, color="C3", ls=style, lw=1.0, label=f"{name.replace('_', '-')} {place:.4g}")
    axes.axhline(0.0, color="0.7", lw=0.8)
    axes.set(xlabel="frequency in the scene (cycles/mrad)", ylabel="MTF along x", xlim=(0.0, None))
    axes.set_title(result["sensor"].replace("$", r"\$"))
    axes.legend(fontsize="small", ncols=2)
    picture = io.BytesIO()
    figure.savefig(picture, format="png", dpi=144, metadata={"Software": None})
    return {"mtf.csv": text.getvalue().encode(), "mtf.png": picture.getvalue()}
