"""The commands `sensor-sim` and `python -m sensor_sim`, ready for Ctrl-C before anything else is imported."""

from todframes.__main__ import start


def main() -> None:
    """Run the command line and end the process."""
    start()
    from sensor_sim.cli import main as run

    run()


if __name__ == "__main__":
    main()
