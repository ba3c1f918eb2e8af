"""EMVA 1288: results as XML, descriptors, and cameras simulated from photons up by code that shares nothing."""

from __future__ import annotations

from pathlib import Path

import pytest

from todframes.base.errors import DataError
from todframes.recordings.emva_xml import EmvaCamera, emva_xml, read_emva_xml

PUBLISHED = r"""<results>
  <info><index_start><Value>0</Value><Unit></Unit></index_start></info>
  <sensitivity>
    <K><Comment>Slope</Comment><Value>0.280769280926</Value><Symbol>K</Symbol><Unit>$DN/e^-$</Unit></K>
    <QE><Value>45.1356082834</Value><Symbol>$\eta$</Symbol><Unit>\%</Unit></QE>
    <sigma_d><Value>10.8980275235</Value><Unit>$e^-$</Unit></sigma_d>
    <u_e_sat><Value>13972.6302563</Value><Unit>$e^-$</Unit></u_e_sat>
  </sensitivity>
  <spatial>
    <DSNU1288><Value>0.551787767644</Value><Unit>$e^-$</Unit></DSNU1288>
    <PRNU1288><Value>0.432704411062</Value><Unit>\%</Unit></PRNU1288>
  </spatial>
  <defect_pixel><histogram_DSNU><Data><bins>0 1</bins></Data></histogram_DSNU></defect_pixel>
  <dark_current><u_I_mean><Value>28.4074312749</Value><Unit>$e^-/s$</Unit></u_I_mean></dark_current>
</results>
"""
"""The form and the numbers of the results that are published with the public reference set 001."""


def test_published_results_are_read(tmp_path: Path) -> None:
    (tmp_path / "camera.xml").write_text(PUBLISHED)
    camera = read_emva_xml(tmp_path / "camera.xml")
    assert camera == EmvaCamera(
        system_gain_dn_per_electron=0.280769280926,
        dark_noise_electrons=10.8980275235,
        quantum_efficiency=pytest.approx(0.451356082834, rel=1e-15),
        dark_current_electrons_per_s=28.4074312749,
        dsnu_electrons=0.551787767644,
        prnu_percent=0.432704411062,
        full_well_electrons=13972.6302563,
    )
    assert camera.noise_table() == {
        "model": "photon",
        "quantum_efficiency": 0.451356,
        "system_gain_dn_per_electron": 0.280769,
        "dark_noise_electrons": 10.898,
        "dark_current_electrons_per_s": 28.4074,
        "dsnu_electrons": 0.551788,
        "prnu_percent": 0.432704,
        "full_well_electrons": 13972.6,
    }


def test_written_results_come_back(tmp_path: Path) -> None:
    values = {
        "K": 0.28,
        "sigma_d": 10.9,
        "QE": 45.0,
        "u_I_mean": -0.5,
        "bits": 12,
        "exposure": 5.16,
        "u_e_sat": None,
    }
    (tmp_path / "camera.xml").write_bytes(emva_xml(values))
    assert read_emva_xml(tmp_path / "camera.xml") == EmvaCamera(
        system_gain_dn_per_electron=0.28,
        dark_noise_electrons=10.9,
        quantum_efficiency=0.45,
        dark_current_electrons_per_s=0.0,
        bits=12,
        exposure_ms=5.16,
    )


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("<results>", "<EMVA1288>", "is no XML"),
        ("results>", "EMVA1288>", "begins with <EMVA1288>, expected <results>"),
        ("<info>", "<info><release><Value>5.1</Value></release>", "info/release: found '5.1', expected a release"),
        ("<info>", "<info><version>2.01</version>", "info/version: found '2.01', expected a release"),
        ("<results>", "<!DOCTYPE x [<!ENTITY a 'b'>]><results>", "has a document type"),
        ("0.280769280926", "0,28", "sensitivity/K: found '0,28', expected a number"),
        ("0.280769280926", "0", "sensitivity/K: found 0, expected a number > 0"),
        (r"45.1356082834", "145", "sensitivity/QE: found 1.45, expected a number > 0 up to 100 %"),
        (
            "<Unit>$DN/e^-$</Unit>",
            "<Unit>mV/e</Unit>",
            "sensitivity/K: found the unit 'mV/e', expected 'DN/e\\^-'",
        ),
        ("sigma_d>", "sigma_e>", "found no sensitivity/sigma_d, expected one"),
        ("0.551787767644", "-1", "spatial/DSNU1288: found -1, expected a number of 0 or more"),
    ],
)
def test_results_of_another_form_are_refused(tmp_path: Path, old: str, new: str, message: str) -> None:
    (tmp_path / "camera.xml").write_text(PUBLISHED.replace(old, new))
    with pytest.raises(DataError, match=message):
        read_emva_xml(tmp_path / "camera.xml")
