"""Texts of files and peers, made safe for printing."""


def printable(text: str) -> str:
    r"""Text in which invisible characters are replaced by escapes such as `\x1b`.

    Some invisible characters make a terminal clear the screen, move the cursor, or reverse text.
    """
    if text.isprintable():
        return text
    return "".join(
        letter if letter.isprintable() else letter.encode("unicode_escape").decode()
        for letter in text
    )
