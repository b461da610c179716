"""``python -m footwork``: the command line."""

from footwork.doors.cli import main

if __name__ == "__main__":
    main()
