r"""Text from outside, made fit for a terminal.

What a terminal is sent it obeys: an escape in a service's message, in a key of a file or in an
exception's text can clear the screen, set the window's title, or write over the line that says what
is wrong. So everything that was not written here goes through this before it is shown, and is seen
as what it is: ``\x1b[2J``.
"""

from __future__ import annotations

__all__ = ["printable"]


def printable(text: str, *, keep: str = "\n\t") -> str:
    """Return a text in which whatever a terminal does not show as a letter is an escape.

    Parameters
    ----------
    text : str
    keep : str
        Characters that stay as they are.
    """
    if text.isprintable():
        return text
    return "".join(
        letter
        if letter.isprintable() or letter in keep
        else letter.encode("unicode_escape").decode()
        for letter in text
    )
