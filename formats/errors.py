"""The one error a user is meant to read."""


class InputError(Exception):
    """Something outside the program is wrong: a file, a setting, a disk.

    The message says what, why and what to do next. The command line prints it without a traceback and ends with
    exit code 1; every other exception is a bug and keeps its traceback.
    """


class SettingError(InputError):
    """A setting, or an option that sets one, cannot be what was asked for: exit code 2, as for an option that
    does not exist."""


class RecoverableError(InputError):
    """The work done so far is kept, and goes on once what the message names is repaired: rights, a vanished source."""


class DiskFullError(RecoverableError):
    """The disk is full."""
