"""What rts2 raises: one line that names the rule, the value given and the remedy."""


class Rts2Error(Exception):
    """The work could not be done. `exit_code` is what a command ends with."""

    exit_code = 1


class UsageError(Rts2Error):
    """The request itself cannot be: an unknown device, a missing file, a target of zero."""

    exit_code = 2


class NothingFeasible(Rts2Error):
    """The request is sound, and no candidate meets it."""

    exit_code = 3
