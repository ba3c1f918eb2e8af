"""The sections of a SENSOR.toml of a camera that counts photons, for tests and campaigns."""

LENS = """[optics]
f_number = 2.8
focal_length_mm = 25.0
wavelength_um = 0.555
"""

PIXELS = """[detector]
pitch_um = 3.45
"""

PHOTONS = """
[scene]
luminance_cd_m2 = 1.0
[noise]
model = "photon"
quantum_efficiency = 0.6
system_gain_dn_per_electron = 0.4
dark_noise_electrons = 2.5
dark_current_electrons_per_s = 100.0
dsnu_electrons = 1.0
prnu_percent = 2.0
full_well_electrons = 10000.0
bits = 12
exposure_ms = 10.0
"""

DISPLAY = """
[display]
pixels_per_detector = 2
pixel_pitch_mm = 0.25
viewing_distance_mm = 600.0
background_luminance_cd_m2 = 50.0
"""
