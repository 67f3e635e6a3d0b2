"""Lines of a text log with their places in the file, which errors name."""

from __future__ import annotations

import codecs
import math
import os
import re
import stat
from collections.abc import Iterable, Sequence
from os import PathLike
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ...arrays import Array
from ...sim_configs.scenario_files import replace_when_written

MAX_ID_DIGITS = 18  # every such number fits int64
LARGEST = 1e100  # number whose square is finite, and sums of such squares are
MAX_SHOWN = 60  # characters of a wrong text that an error repeats
_COMMENT = re.compile(r"#|%|//")
_UTF_16 = (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)


class LogError(ValueError):
    """A log cannot be read or written; the message names file and reason in a line."""


class LogLine(NamedTuple):
    """One line of a log and its place in the file.

    Attributes
    ----------
    file : str
        Path of the file, as the caller gave it.
    number : int
        Line number, counted from 1.
    text : str
        The line without surrounding white space.

    Examples
    --------
    >>> line = LogLine("drive.csv", 7, "odometry,1,east")
    >>> line.to_real("2.5")
    2.5
    >>> line.to_real("east")
    Traceback (most recent call last):
    slamgym.experiments.logs.log_lines.LogError: drive.csv, line 7: expected a finite \
number, got 'east'
    """

    file: str
    number: int
    text: str

    def error(self, expected: str, got: str) -> LogError:
        """Return an error with this line, what was expected, and what was found."""
        return LogError(
            f"{self.file}, line {self.number}: expected {expected}, got {got}"
        )

    def to_real(self, field: str) -> float:
        """Read a number of at most ±1e100; raise LogError for anything else."""
        try:
            value = float(field)
        except ValueError:
            value = math.nan
        if not abs(value) <= LARGEST or "_" in field:
            is_large = LARGEST < abs(value) < math.inf
            wanted = f"a number up to {LARGEST:g}" if is_large else "a finite number"
            raise self.error(wanted, shown(field))
        return value

    def to_reals(self, fields: Sequence[str]) -> list[float]:
        """Read numbers as :meth:`to_real` does, in less time."""
        try:
            values = [*map(float, fields)]
        except ValueError:
            values = [math.nan]
        is_plain = sum(map(abs, values)) <= LARGEST and "_" not in self.text
        return values if is_plain else [*map(self.to_real, fields)]

    def to_id(self, field: str) -> int:
        """Read a whole number >= 0; raise LogError for anything else."""
        if not (field.isascii() and field.isdigit() and len(field) <= MAX_ID_DIGITS):
            wanted = f"an id (a whole number >= 0 of at most {MAX_ID_DIGITS} digits)"
            raise self.error(wanted, shown(field))
        return int(field)

    def check_count(
        self, fields: list[str], counts: tuple[int, ...], form: str
    ) -> None:
        """Raise LogError unless the number of fields is one of ``counts``."""
        if len(fields) not in counts:
            raise self.error(form, f"{len(fields)} fields in {shown(self.text)}")


def shown(text: str) -> str:
    """Quote a text for an error message, cut to a readable length.

    Examples
    --------
    >>> shown("east")
    "'east'"
    """
    quoted = repr(text[: MAX_SHOWN + 1])  # no copy of a huge field
    return quoted if len(quoted) <= MAX_SHOWN else quoted[:MAX_SHOWN] + "…"


def to_lines(text: str, file: str) -> list[LogLine]:
    r"""Split a text into lines, without blank ones.

    Raises
    ------
    LogError
        If no line is left.

    Examples
    --------
    >>> [line.number for line in to_lines("a\n\n  b\n", "notes.txt")]
    [1, 3]
    """
    if "\n" not in text:
        text = text.replace("\r", "\n")
    stripped = (line.strip() for line in text.split("\n"))
    lines = [LogLine(file, k, line) for k, line in enumerate(stripped, 1) if line]
    if not lines:
        raise LogLine(file, 1, "").error("rows", "an empty file")
    return lines


def content_of(lines: list[LogLine]) -> list[LogLine]:
    r"""Return lines without comments, and without a first row of column names.

    A comment begins with ``#``, ``%`` or ``//``, and ends with its line.

    Raises
    ------
    LogError
        If no line is left.

    Examples
    --------
    >>> lines = to_lines("# by hand\nt x y\n0 1 2  # start\n", "path.txt")
    >>> [line.text for line in content_of(lines)]
    ['0 1 2']
    """
    texts = ((line, without_comment(line.text)) for line in lines)
    found = [
        line if text is line.text else line._replace(text=text)
        for line, text in texts
        if text
    ]
    if not found:
        raise lines[0].error("rows", "comments only")
    is_header = not any(map(is_number, split_fields(found[0].text)))
    return found[1:] if is_header and len(found) > 1 else found


def without_comment(text: str) -> str:
    """Return a line up to its comment."""
    if not ("#" in text or "%" in text or "//" in text):  # faster than the pattern
        return text
    return _COMMENT.split(text, maxsplit=1)[0].strip()


def split_fields(text: str) -> list[str]:
    """Split a line at its semicolons, commas or tabs, or else at white space.

    Between semicolons, a comma is that of a decimal number.

    Examples
    --------
    >>> split_fields("1, 2,,3"), split_fields("1 2  3"), split_fields("1,5; 2")
    (['1', '2', '', '3'], ['1', '2', '3'], ['1.5', '2'])
    """
    separator = next((mark for mark in ";,\t" if mark in text), None)
    if separator == ";":
        text = text.replace(",", ".")
    return [field.strip(" \t\"'") for field in text.split(separator)]


def plain_rows(texts: Sequence[str], separator: str | None = None) -> Array | None:
    """Read rows of numbers at once; None if `LogLine.to_reals` has to read each line.

    Examples
    --------
    >>> plain_rows(["1,2", "3,4e5"], ","), plain_rows(["1,2", "3,east"], ",")
    (array([[1.e+00, 2.e+00],
           [3.e+00, 4.e+05]]), None)
    """
    if not texts or not all(map(str.strip, texts)):
        return None  # numpy leaves out blank rows
    try:
        rows = np.loadtxt(texts, delimiter=separator, comments=None, ndmin=2)
    except ValueError:
        return None
    return rows if (abs(rows) <= LARGEST).all() else None


def is_number(field: str) -> bool:
    """Whether a field is a number, finite or not."""
    try:
        float(field)
    except ValueError:
        return False
    return True


class ReadFile(PathLike[str]):
    """The path of a file with its content, which a pipe gives only once.

    Raises
    ------
    LogError
        If it is a device, such as /dev/zero, whose content may have no end.
    OSError
        If it cannot be opened.
    """

    def __init__(self, path: str | PathLike[str]) -> None:
        self._path = os.fspath(path)
        mode = os.stat(self._path).st_mode
        if stat.S_ISCHR(mode) or stat.S_ISBLK(mode):
            raise LogError(f"{path} must be a file or a pipe, got a device")
        self.content = Path(path).read_bytes()

    def __fspath__(self) -> str:
        return self._path

    def __str__(self) -> str:
        return self._path


def read_lines(path: str | PathLike[str]) -> list[LogLine]:
    """Read the lines of a text file that are not blank; see :func:`read_text`.

    Raises
    ------
    LogError
        Also if the file is empty.
    """
    return to_lines(read_text(path), str(path))


def read_text(path: str | PathLike[str]) -> str:
    """Read a text file in UTF-8, or marked UTF-16.

    Raises
    ------
    LogError
        If the file is no such text, or a device.
    OSError
        If the file cannot be opened.
    """
    data = (path if isinstance(path, ReadFile) else ReadFile(path)).content
    try:
        return data.decode("utf-16" if data.startswith(_UTF_16) else "utf-8-sig")
    except UnicodeDecodeError as error:
        line = LogLine(str(path), data.count(b"\n", 0, error.start) + 1, "")
        byte = f"byte 0x{data[error.start]:02x}: save the file as UTF-8"
        raise line.error("UTF-8 text", byte) from None


def rows_of(separator: str, *columns: Iterable[str]) -> list[str]:
    """Write rows from columns of texts.

    Examples
    --------
    >>> rows_of(",", ["a", "b"], ["1.0", "2.0"])
    ['a,1.0', 'b,2.0']
    """
    return list(map(separator.join, zip(*columns, strict=False)))


def columns_of(
    lines: Iterable[str], tag: str, separator: str, count: int
) -> list[list[str]]:
    """Return the columns of the rows that begin with a tag, without the tag.

    It is the inverse of `rows_of`, for files that this package has written.

    Raises
    ------
    ValueError
        If such a row does not have ``count`` fields.

    Examples
    --------
    >>> columns_of(["a,1,2", "b,1", "a,3,4"], "a", ",", 3)
    [['1', '3'], ['2', '4']]
    """
    rows = [line for line in lines if line.startswith(tag + separator)]
    fields = separator.join(rows).split(separator) if rows else []
    if len(fields) != count * len(rows) or fields[::count] != [tag] * len(rows):
        raise ValueError(f"rows of {tag} must have {count} fields")
    return [fields[place::count] for place in range(1, count)]


def table_of(columns: Iterable[Iterable[str]]) -> Array:
    """Read numbers from columns of texts, shape (rows, columns).

    Examples
    --------
    >>> table_of([["1", "2"], ["0.5", "nan"]])
    array([[1. , 0.5],
           [2. , nan]])
    """
    return np.column_stack([np.array([*map(float, each)]) for each in columns])


def write_whole(path: str | PathLike[str], text: str) -> None:
    """Write a UTF-8 text file, which appears complete or not at all.

    Raises
    ------
    LogError
        If the file cannot be written.
    """
    target = Path(path).resolve()
    if target.exists() and not target.is_file():
        raise LogError(f"{path}: cannot be written: not a regular file")
    try:
        with (
            replace_when_written(target) as partial,
            partial.open("x", encoding="utf-8", newline="\n") as stream,
        ):
            stream.write(text)
            stream.flush()
            os.fsync(stream.fileno())
    except OSError as error:
        reason = error.strerror or error
        raise LogError(f"{path}: cannot be written: {reason}") from error
