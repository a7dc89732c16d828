"""Colours of modes and states, shared by the page and reports."""

from collections.abc import Mapping

from skytether.shared.wire.protocol import Mode

Rgb = tuple[int, int, int]

GREY, GREEN, AMBER, RED, BLUE, VIOLET = "grey", "green", "amber", "red", "blue", "violet"
PALETTE: Mapping[str, Rgb] = {
    GREY: (134, 142, 150),
    GREEN: (55, 178, 77),
    AMBER: (245, 159, 0),
    RED: (240, 62, 62),
    BLUE: (34, 139, 230),
    VIOLET: (132, 94, 247),
}
MODE_COLOURS: Mapping[Mode, str] = {
    Mode.INIT: GREY,
    Mode.SYNC: GREY,
    Mode.READY: GREY,
    Mode.TRACK: GREEN,
    Mode.COAST: AMBER,
    Mode.BRAKE: RED,
    Mode.HOVER: BLUE,
    Mode.LAND: VIOLET,
    Mode.RETURN: VIOLET,
    Mode.MANUAL: GREY,
    Mode.FAULT: RED,
}


def css(rgb: Rgb) -> str:
    return f"#{bytes(rgb).hex()}"
