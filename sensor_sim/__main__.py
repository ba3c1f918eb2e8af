"""`python -m sensor_sim` is the command `sensor-sim`."""

from sensor_sim.cli import main

main()
