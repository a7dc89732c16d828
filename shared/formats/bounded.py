"""Files of other programs, read within bounds: zips, tables, JSON and XML.

Each bound is checked before the work that it limits, because a small file can take much time and
memory: a zip of 60 kB may contain 60 MB of commas, and a reader makes a text for each cell.
"""

import csv
import io
import json
import zipfile
import zlib
from collections.abc import Callable, Iterator, Mapping
from typing import Any
from xml.etree import ElementTree

COLUMNS_MAX = 64
"""Largest number of columns of a table."""
LINES_MAX = 2_000_000
"""Largest number of lines of all tables in a file."""
MEMBERS_MAX = 65_535
"""Largest number of files in a zip."""
ZIP_BYTES_MAX = 64_000_000
"""Largest size of all files in a zip together, and largest size of a table [B]."""
PARTS_MAX = 2_000_000
"""Largest number of lists and objects in a JSON text."""
POINTS_MAX = 1_000_000
"""Largest number of points of all vehicles in a file."""
SAMPLE_S = 0.05
"""Longest time between two points made from a curve [s]."""
ELEMENTS_MAX = 500_000
"""Largest number of elements and attributes in an XML text."""
CHUNK_BYTES, TAG_BYTES_MAX = 1 << 16, 1 << 20
"""Size of the parts in which XML is parsed, and largest size of a tag or comment [B]."""


UNREADABLE = (zipfile.BadZipFile, zlib.error, RuntimeError, NotImplementedError, EOFError)
"""Exceptions that Python raises if a zip cannot be read."""


# -- zips -----------------------------------------------------------------------------------------


def is_zip(content: bytes) -> bool:
    return content.startswith(b"PK")


def names(content: bytes) -> list[str]:
    """Names of the files in a zip; none if the zip cannot be read."""
    try:
        return [each.filename for each in _opened(content).infolist()] if is_zip(content) else []
    except (*UNREADABLE, ValueError):
        return []


def _opened(content: bytes) -> zipfile.ZipFile:
    if content.count(b"PK\1\2") > MEMBERS_MAX:  # signature of each entry in the zip's directory
        raise ValueError(f"expected a zip of at most {MEMBERS_MAX} files")
    return zipfile.ZipFile(io.BytesIO(content))


def members(content: bytes, is_wanted: Callable[[str], bool], what: str) -> dict[str, bytes]:
    """Files in a zip, by name.

    Args:
        is_wanted: returns whether to read a file of this name.
        what: plural noun for these files in messages.

    Raises:
        ValueError: the zip cannot be read, has no wanted file, or is too large.
    """
    try:
        with _opened(content) as archive:
            files = [each for each in archive.infolist() if is_wanted(each.filename)]
            size = sum(each.file_size for each in files)
            if not 0 < len(files) <= MEMBERS_MAX or size > ZIP_BYTES_MAX:
                most = f"at most {MEMBERS_MAX} with {ZIP_BYTES_MAX / 1e6:g} MB together"
                raise ValueError(f"expected {what}, {most}, got {len(files)}")
            found = {each.filename: _member(archive, each) for each in files}
            if len(found) < len(files):
                raise ValueError("expected a zip without two files of the same name")
    except UNREADABLE as error:
        raise ValueError(f"expected a zip that can be read ({error})") from None
    return found


def _member(archive: zipfile.ZipFile, file: zipfile.ZipInfo) -> bytes:
    """Content of a file in a zip; raises ValueError if it is longer than the zip states."""
    if file.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        raise ValueError(f"{file.filename[:80]}: expected the compression deflate, or none")
    with archive.open(file) as member:
        content = member.read(file.file_size + 1)
    if len(content) > file.file_size:
        raise ValueError(f"{file.filename[:80]}: expected the size that the zip states")
    return content


# -- tables ---------------------------------------------------------------------------------------


def check_lines(tables: Mapping[str, bytes]) -> None:
    """Raise a ValueError if tables have too many lines in total."""
    lines = sum(max(each.count(b"\n"), each.count(b"\r")) for each in tables.values())
    if lines > LINES_MAX:
        raise ValueError(f"expected at most {LINES_MAX} lines, got {lines}")


def rows(content: bytes) -> Iterator[tuple[int, list[str]]]:
    """Non-empty rows of a CSV table, each with the number of its line, from 1.

    Raises:
        ValueError: the table is invalid; the message names the fault and the line.
    """
    check_lines({"": content})
    try:
        content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = content.count(b"\n", 0, error.start) + 1
        raise ValueError(f"line {line}: expected text in UTF-8") from None
    text = io.TextIOWrapper(io.BytesIO(content), "utf-8-sig", newline="")
    line, begun = 0, 0

    def lines() -> Iterator[str]:
        nonlocal line
        for line, each in enumerate(text, start=1):
            if each.count(",") >= COLUMNS_MAX:
                raise ValueError(f"line {line}: expected at most {COLUMNS_MAX} columns")
            if line > begun + 1:
                raise ValueError(f"line {begun + 1}: expected each row on a single line")
            yield each

    try:
        for row in csv.reader(lines(), skipinitialspace=True):
            begun = line
            if row:
                yield line, row
    except csv.Error as error:
        raise ValueError(f"line {line}: {error}") from None


# -- JSON and XML ---------------------------------------------------------------------------------


def json_of(content: bytes) -> Any:
    """Value of a JSON text.

    Raises:
        ValueError: the text is invalid, too long, or nested too deeply.
    """
    parts = content.count(b"[") + content.count(b"{")
    if parts > PARTS_MAX:
        raise ValueError(f"at most {PARTS_MAX} lists and objects, got {parts}")
    try:
        return json.loads(content)
    except RecursionError as error:
        raise ValueError(str(error)) from None


class _Elements(ElementTree.TreeBuilder):
    """Builder of a bounded XML tree; refuses document types, which could define entities."""

    def __init__(self) -> None:
        super().__init__()
        self._count = 0
        self.has_come = False
        """Whether an element or text has been parsed since this flag was last set to False."""

    def start(self, tag: Any, attrs: Any, /) -> Any:
        self._count, self.has_come = self._count + 1 + len(attrs), True
        if self._count > ELEMENTS_MAX:
            raise ValueError(f"of at most {ELEMENTS_MAX} elements and attributes")
        return super().start(tag, attrs)

    def data(self, data: str, /) -> None:
        self.has_come = True
        super().data(data)

    def doctype(self, *_: Any) -> None:
        raise ValueError("without a document type or entities")


def xml_of(content: bytes) -> ElementTree.Element:
    """Root of an XML text.

    Raises:
        ValueError: the text is invalid or too large, or has a document type; the message continues
            a sentence such as "expected a GPX file".
    """
    made = _Elements()
    parser, silent = ElementTree.XMLParser(target=made), 0
    try:
        for at in range(0, len(content), CHUNK_BYTES):
            parser.feed(content[at : at + CHUNK_BYTES])
            silent = 0 if made.has_come else silent + CHUNK_BYTES
            if silent > TAG_BYTES_MAX:
                raise ValueError(f"with tags of at most {TAG_BYTES_MAX} bytes")
            made.has_come = False
        root: ElementTree.Element = parser.close()
    except (ElementTree.ParseError, LookupError) as error:
        raise ValueError(f"({error})") from None
    return root
