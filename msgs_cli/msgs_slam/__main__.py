"""`python -m msgs_slam`: the command `msgs-slam`."""

from msgs_slam import main

if __name__ == "__main__":
    main()
