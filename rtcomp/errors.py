"""The two ways a command ends badly, both with one sentence for a person, and how foreign text is shown in it."""


class RequestError(Exception):
    """The request was wrong (exit status 2): says what was got, what was wanted, what to do."""


class WorkError(Exception):
    """The request was right but the work failed (exit status 1)."""


def printable(text: str) -> str:
    """One line of text that does nothing to a terminal or a log but appear: control characters become escapes.

    For what came in a message or a file and is shown in an error.
    """
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)
