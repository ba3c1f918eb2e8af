"""Files that the commands write beside `result.json`; a result in their place removes those it does not have."""

CURVE = frozenset({"report.html", "psychometric.png", "tod_curve.png"})
SWEEP = frozenset(
    {
        "report.html",
        "sweep.csv",
        "sweep.parquet",
        "front.png",
        "map.png",
        "range_map.png",
        "by_key.png",
        "tod_curves.png",
    }
)
MRTD = frozenset(
    {"report.html", "bars.csv", "tod.csv", "mrtd.csv", "mrtd_best_phase.csv", "mrtd_lloyd.csv", "mrtd.png"}
)
