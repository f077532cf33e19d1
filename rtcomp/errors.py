"""The two ways a command ends badly; both carry one sentence for a person."""


class RequestError(Exception):
    """The request was wrong (exit status 2): says what was got, what was wanted, what to do."""


class WorkError(Exception):
    """The request was right but the work failed (exit status 1)."""
