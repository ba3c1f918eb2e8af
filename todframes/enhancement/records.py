"""Records and tables of algorithms, and of a comparison of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from todframes.enhancement.algorithm import Enhancement
from todframes.enhancement.compare import AlgorithmResult, Compared
from todframes.enhancement.comparison import NO_DIFFERENCE, Algorithm, ContrastPoint, ContrastResponse, Ratio
from todframes.frames.dataset import Dataset
from todframes.results.data import Record, group_of
from todframes.results.table import Column, Table
from todframes.scoring.records import fit_record, trials_table

PSNR_STEP_DB, SSIM_STEP = 0.1, 0.005
"""Largest changes of PSNR and SSIM that count as no change."""


def algorithms(dataset: Dataset, results: Sequence[AlgorithmResult]) -> tuple[Algorithm, ...]:
    """Return the records of compared algorithms, the reference first."""
    reference, names = results[0], [one.enhancement.name for one in results]
    found = []
    for one in results:
        algorithm = one.enhancement
        ratios = tuple(_ratio(dataset, compared) for compared in one.compared)
        overall = None if one.overall is None else _ratio(dataset, one.overall)
        verdict = overall.verdict if overall is not None else ratios[0].verdict if ratios else None
        changes = {
            "psnr_change_db": _difference(one.psnr_db, reference.psnr_db),
            "ssim_change": _difference(one.ssim, reference.ssim),
        }
        found.append(
            Algorithm(
                name=algorithm.name if names.count(algorithm.name) == 1 else algorithm.spec,
                spec=algorithm.spec,
                what=algorithm.what,
                library=algorithm.declaration.library,
                domain=algorithm.declaration.domain,
                parameters={name: plain_value(value) for name, value in algorithm.values.items()},
                magnification=algorithm.magnification,
                fits=tuple(fit_record(dataset, fit) for fit in one.scored.fits),
                ratios=ratios,
                overall=overall,
                verdict=verdict,
                contrast_responses=tuple(
                    ContrastResponse(
                        group=group_of(dataset, fit.group), points=tuple(ContrastPoint(*each) for each in of_group)
                    )
                    for fit, of_group in zip(one.scored.fits, one.responses, strict=bool(one.responses))
                ),
                n_scenes=one.n_backgrounds,
                psnr_db=one.psnr_db,
                ssim=one.ssim,
                **changes,
                disagrees=() if verdict is None else _disagreeing(changes, verdict),
                edge_factor=one.edge_factor,
                repeat_difference=one.repeat_difference,
                n_clipped=one.n_clipped,
                cpu_s=round(one.cpu_s, 4),
                cpu_ms_per_frame=round(1e3 * one.cpu_s_per_frame, 3),
                memory_mb=None if one.memory_mb is None else round(one.memory_mb, 1),
            )
        )
    return tuple(found)


def _ratio(dataset: Dataset, compared: Compared) -> Ratio:
    beyond = compared.beyond_gain
    return Ratio(
        verdict=compared.verdict,
        group={} if compared.group is None else group_of(dataset, compared.group),
        ratio=compared.ratio.ratio,
        ratio_ci95=compared.ratio.ratio_ci95,
        p_value=compared.ratio.p_value,
        p_value_holm=compared.p_value_holm,
        p_value_is_least=compared.is_p_value_least,
        contrast_gain=None if beyond is None else beyond.contrast_gain,
        beyond_gain=None if beyond is None else beyond.ratio.ratio,
        beyond_gain_ci95=None if beyond is None else beyond.ratio.ratio_ci95,
    )


def plain_value(value: object) -> object:
    """Return a parameter's value as a JSON value, or as a text if JSON has no such value."""
    if isinstance(value, Mapping):
        return {str(name): plain_value(one) for name, one in value.items()}
    return value if value is None or isinstance(value, bool | int | float | str) else repr(value)


def _difference(value: float | None, reference: float | None) -> float | None:
    return None if value is None or reference is None else value - reference


def _disagreeing(changes: dict[str, float | None], verdict: str) -> tuple[str, ...]:
    """List those of PSNR and SSIM that contradict the observer's verdict."""
    found = []
    for name, key, step in (("psnr", "psnr_change_db", PSNR_STEP_DB), ("ssim", "ssim_change", SSIM_STEP)):
        change = changes[key]
        if change is not None:
            opinion = NO_DIFFERENCE if abs(change) < step else "better" if change > 0 else "worse"
            found += [name] if opinion != verdict else []
    return tuple(found)


def enhancement_record(algorithm: Enhancement) -> Record:
    """Return the description of a registered algorithm, as `todframes enhancements --json` prints it."""
    return {
        "name": algorithm.name,
        "what": algorithm.what,
        "domain": algorithm.declaration.domain,
        "changes_pitch": algorithm.declaration.magnification != 1.0,
        "clip": algorithm.declaration.clip,
        "library": algorithm.declaration.library,
        "parameters": [
            {
                "name": one.name,
                "default": plain_value(one.default),
                "unit": (one.meta.extra or {}).get("unit") or None,
                "range": None if one.meta.ge is None else [one.meta.ge, one.meta.le],
                "choices": list(one.choices) or None,
                "what": one.meta.description or None,
            }
            for one in algorithm.parameters
        ],
    }


def compared_trials(dataset: Dataset, results: Sequence[AlgorithmResult]) -> Table:
    """Make the table of scored trials after each algorithm."""
    return trials_table(dataset, [({"algorithm": one.enhancement.spec}, one.scored) for one in results])


def enhancements_table(listed: Sequence[Record]) -> Table:
    """Make the table of registered algorithms, with a row for each parameter below its algorithm."""
    records: list[Record] = []
    for one in listed:
        takes = one["domain"].replace("_", " ") + "s" * (one["domain"] == "code_value") + ", clips" * one["clip"]
        records.append({"name": one["name"], "what": one["what"], "takes": takes, "from": one["library"]})
        for parameter in one["parameters"]:
            default, ends = parameter["default"], parameter["range"] or ()
            shown = f"{default:g}" if isinstance(default, float) else str(default)
            span = ", ".join(map(str, parameter["choices"] or ())) or " – ".join(f"{end:g}" for end in ends)
            records.append(
                {
                    "name": f"  {parameter['name']}",
                    "what": parameter["what"],
                    "default": " ".join(filter(None, (shown, parameter["unit"]))),
                    "range": span,
                }
            )
    columns = [
        Column(key="name"),
        Column(key="what", header="what it does; what a parameter is", none="", wraps=True),
        Column(key="default", none=""),
        Column(key="range", none="", wraps=True, rank=1),
        Column(key="takes", none="", rank=2),
        Column(key="from", none="", rank=3),
    ]
    return Table.of("Enhancement algorithms", "enhancements.csv", columns, records)
