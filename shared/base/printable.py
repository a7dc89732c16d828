"""Texts of files and peers, made safe for printing."""


def printable(text: str) -> str:
    r"""Text in which characters that are not visible are replaced by escapes such as `\x1b`.

    A terminal obeys some of them: it clears the screen, moves the cursor, or reverses the direction
    of text.
    """
    if text.isprintable():
        return text
    return "".join(
        letter if letter.isprintable() else letter.encode("unicode_escape").decode()
        for letter in text
    )
