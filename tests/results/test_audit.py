"""What a result says about the dataset, so that it can be checked later."""

from __future__ import annotations

import csv
import hashlib
import io
import json

import numpy as np
import pytest

from todframes import compare, score
from todframes.frames.dataset import load_dataset
from todframes.psychometrics.fit import FitSettings
from todframes.results.data import DatasetRecord
from todframes.results.result import load_result, read_result
from todframes.results.tables import dataset as dataset_table
from todframes.results.tables import thresholds

QUICK = FitSettings(resamples=0)


def test_a_result_names_display_experiment_and_manifest(make_dataset) -> None:
    made = make_dataset(display={"pixel_pitch_mrad": None, "pixel_pitch_mm": 0.25, "viewing_distance_mm": 1000.0})
    result = score(made.path, fit=QUICK, examples=False)
    record = json.loads(result.to_json())["dataset"]
    assert record["path"] == str(made.path)
    assert record["manifest_sha256"] == hashlib.sha256(made.manifest_file.read_bytes()).hexdigest()
    assert record["n_frames"] == 8
    assert record["experiment"] == {"level": "contrast", "group_by": ["size_mrad"]}
    # 0.25 mm at 1 m are 0.25 mrad but for (0.25e-3)² / 12 of it, 5e-9.
    assert record["display"].pop("pixel_pitch_mrad") == pytest.approx(0.25, rel=1e-8)
    wanted = made.toml["display"] | {"black_luminance_cd_m2": 0.0}
    assert record["display"] == {name: value for name, value in wanted.items() if name != "pixel_pitch_mrad"}
    assert {"python", "todframes", "numpy", "OpenImageIO"} <= result.versions.keys()
    text = result.to_html()
    assert "Dataset and display" in text
    assert record["manifest_sha256"] in text


def test_left_out_frames_are_counted(make_dataset) -> None:
    made = make_dataset(row_changes={0: {"orientation": "sideways"}})
    result = score(made.path, fit=QUICK, examples=False, on_error="skip")
    assert isinstance(result.dataset, DatasetRecord)
    assert (result.dataset.n_frames, len(result.skipped)) == (8, 1)


def test_the_background_used_is_the_mean_of_the_trials(make_dataset) -> None:
    """Each size has its own background, which varies from frame to frame."""
    given = [10.0, 20.0, 30.0, 40.0, 10.0, 20.0, 30.0, 80.0] * 2
    made = make_dataset(
        sizes_mrad=(1.0, 2.0),
        contrasts=(0.1, 0.5),
        display={"background_luminance_cd_m2": "column"},
        row_changes={
            row: {"background_luminance_cd_m2": str(value * (1 + row // 8))} for row, value in enumerate(given)
        },
    )
    result = score(made.path, fit=QUICK, examples=False)
    # The mean of eight values, and twice that; a few roundings of 2**-53.
    found = [fit.background_luminance_cd_m2 for fit in result.fits]
    assert found == pytest.approx([sum(given[:8]) / 8, sum(given[:8]) / 4], rel=1e-14)
    rows = list(csv.DictReader(io.StringIO(thresholds(result.fits).csv())))
    assert [float(row["background_luminance_cd_m2"]) for row in rows] == found


def brighter(image):
    return 1.25 * image


def test_the_background_after_an_algorithm_is_that_of_its_picture(make_dataset) -> None:
    made = make_dataset(contrasts=(0.05, 0.1), display={"background_luminance_cd_m2": "border"})
    how = {"white": 1e4, "allow_clipping": True, "fit": FitSettings(resamples=40), "examples": False}
    result = compare(made.path, enhance=[brighter], **how)
    reference, after = (one.fits[0].background_luminance_cd_m2 for one in result.conditions)
    assert after == pytest.approx(1.25 * reference, rel=1e-6)  # 32-bit code values


def test_a_look_up_table_is_whole_in_the_result_and_short_on_the_page(make_dataset) -> None:
    made = make_dataset(display={"eotf": "lut", "lut": "lut.csv", "white_luminance_cd_m2": None}, suffix=".png")
    luminance = np.linspace(0.0, 100.0, 256)
    rows = "".join(f"{code / 255},{light}\n" for code, light in enumerate(luminance))
    (made.path / "lut.csv").write_text(f"code_value,luminance_cd_m2\n{rows}", encoding="utf-8")
    record = DatasetRecord.of(load_dataset(made.path))
    assert record.display["lut"]["luminance_cd_m2"] == luminance.tolist()
    assert not {"white_luminance_cd_m2", "black_luminance_cd_m2", "gamma"} & record.display.keys()
    values = {row["name"]: row["value"] for row in dataset_table(record).records}
    assert values["display.lut.code_value"] == "256 values from 0.0 to 1.0"
    assert values["display.lut.luminance_cd_m2"] == "256 values from 0.0 to 100.0"


GROUP = {"group": {"size_mrad": 2.0}, "x_px": 15.5, "y_px": 20.25, "moved_px": None, "standard_error_px": 0.02}


@pytest.mark.parametrize(
    ("dataset", "others", "caution"),
    [
        (
            {"motion_mrad": 0.5},
            {"settings": {"gaze": "tracked"}},
            "up to 0.500 mrad from its mean place; the gaze",
        ),
        ({"n_scenes": 1}, {}, "All trials are on one scene: "),
        ({"n_scenes": 7}, {}, "take the 7 scenes as drawn from many"),
        ({"n_scenes": 2, "experiment": {"group_by": ["scene"]}}, {}, " of a scene hold for it, and nothing is"),
        ({}, {"located": [GROUP | {"n_located": 6, "n_trials": 9}]}, "6 of 9 trials were located one by one"),
    ],
)
def test_a_result_says_what_its_thresholds_hold_for(results, dataset, others, caution) -> None:
    made = results["score"] | others
    made["dataset"] |= dataset
    text = " ".join(read_result(json.dumps(made).encode(), "result").summary().split())
    assert caution in text


def test_positions_found_are_in_words(results) -> None:
    moved = GROUP | {"moved_px": [0.5, -0.25]}
    unseen = GROUP | {"standard_error_px": None}
    made = results["score"] | {"located": [GROUP, moved, unseen]}
    assert [one for one in read_result(json.dumps(made).encode(), "result").notes() if "located: " in one] == [
        "located: 2 mrad: x_px 15.50, y_px 20.25 (± 0.02 px)",
        "located: 2 mrad: +0.50 in x, -0.25 in y from the manifest's positions (± 0.02 px)",
        "located: 2 mrad: no triangle stands out near the manifest's positions, which stay",
    ]


@pytest.mark.usefixtures("blank_pictures")
def test_results_of_earlier_versions_name_the_folder_alone(results, tmp_path) -> None:
    (tmp_path / "result.json").write_text(
        json.dumps(results["score"] | {"dataset": "my_camera"}), encoding="utf-8"
    )
    old = load_result(tmp_path)
    assert (old.dataset, old.dataset_path) == ("my_camera", "my_camera")
    text = old.to_html()
    assert '<p class="about">my_<wbr/>camera</p>' in text
    assert "Dataset and display" not in text
    assert json.loads(old.to_json())["dataset"] == "my_camera"
