"""Texts of files and peers, as they may be printed."""


def printable(text: str) -> str:
    r"""Text in which an escape such as `\x1b` stands for each character that is not visible.

    A terminal obeys some of these: it clears the screen, writes elsewhere, or turns the direction
    of what follows.
    """
    if text.isprintable():
        return text
    return "".join(
        letter if letter.isprintable() else letter.encode("unicode_escape").decode()
        for letter in text
    )
