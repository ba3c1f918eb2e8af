"""The MRTD of a sensor, from patterns of four bars."""
