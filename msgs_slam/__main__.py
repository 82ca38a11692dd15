"""`python -m msgs_slam`: the command `msgs-slam`."""

from . import main

if __name__ == "__main__":
    main()
