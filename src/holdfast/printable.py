r"""Untrusted text, escaped for a terminal.

A terminal executes control characters: an escape sequence in a service's message, a key of a file
or an exception's text can clear the screen, set the window's title, or overwrite an error message.
So untrusted text is escaped before it is printed: ``\x1b[2J``.
"""

from __future__ import annotations

__all__ = ["printable"]


def printable(text: str, *, keep: str = "\n\t") -> str:
    """Return the text with each unprintable character escaped."""
    if text.isprintable():
        return text
    return "".join(
        letter
        if letter.isprintable() or letter in keep
        else letter.encode("unicode_escape").decode()
        for letter in text
    )
