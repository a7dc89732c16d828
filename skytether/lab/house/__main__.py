"""Writes every picture of the code into a folder."""

import sys
from pathlib import Path

from skytether.lab.house.packet import packet_svg
from skytether.lab.house.rooms import rooms_svg
from skytether.shared.base import files

PICTURES = {"rooms.svg": rooms_svg, "packet.svg": packet_svg}
"""Function that draws each file."""


def main(folder: str) -> None:
    """Write every picture into a folder."""
    drawn = {name: draw() for name, draw in PICTURES.items()}
    for name, text in drawn.items():
        files.write(Path(folder) / name, text.encode())


if __name__ == "__main__":
    main(*sys.argv[1:])
