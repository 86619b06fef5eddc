"""YAML read strictly: plain data, and the line on which every value stands.

A configuration file that is misread is worse than one that is refused: the run goes through and
means something else. So this reader takes the part of YAML that every reader understands alike and
refuses the rest, with the line. Plain scalars follow YAML 1.2 (``1e-3`` is a number, which PyYAML
alone takes for text); those that YAML 1.1 and 1.2 read differently (``no``, ``010``, ``1:30``,
``1_000``) have to be rewritten or quoted; a key that stands twice, a tag, a value that is not
finite and a document made to exhaust memory are errors. ruamel.yaml, which loads as fast, reads
``no``, ``010`` and ``1_000`` by YAML 1.2 without a word, makes dates, and has no bounds: to refuse
these with their lines would take as much code on top of it.

:func:`write` is the inverse: what it writes, :func:`read` gives back.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, cast

import yaml

from holdfast.errors import ConfigurationError
from holdfast.printable import brief
from holdfast.validation import KeyPath, dotted

MAX_BYTES = 1024 * 1024
"""Largest document, in bytes."""

MAX_DEPTH = 32
"""Most levels of lists and mappings within each other."""

MAX_VALUES = 100_000
"""Most keys and values in a document, those that an alias repeats counted each time."""

_NULL = "tag:yaml.org,2002:null"
_BOOL = "tag:yaml.org,2002:bool"
_INT = "tag:yaml.org,2002:int"
_FLOAT = "tag:yaml.org,2002:float"
_STR = "tag:yaml.org,2002:str"
_SEQUENCE = "tag:yaml.org,2002:seq"
_MAPPING = "tag:yaml.org,2002:map"
_AMBIGUOUS = "!ambiguous"

# One table for reader and writer: a text that the reader would take for something else is exactly
# one that the writer must quote.
_PLAIN_SCALARS = (
    (_NULL, r"(?:~|null|Null|NULL|)\Z"),
    (_BOOL, r"(?:true|True|TRUE|false|False|FALSE)\Z"),
    (
        _AMBIGUOUS,
        r"(?:yes|Yes|YES|no|No|NO|on|On|ON|off|Off|OFF"
        r"|[-+]?0[0-9]+"
        r"|[-+]?[0-9][0-9_]*(?::[0-5]?[0-9])+(?:\.[0-9_]*)?"
        r"|[-+]?[0-9][0-9.]*_[0-9_.eE+-]*)\Z",
    ),
    (_INT, r"(?:[-+]?[0-9]+|0x[0-9a-fA-F]+)\Z"),
    (
        _FLOAT,
        r"(?:[-+]?(?:\.[0-9]+|[0-9]+(?:\.[0-9]*)?)(?:[eE][-+]?[0-9]+)?"
        r"|[-+]?\.(?:inf|Inf|INF)|\.(?:nan|NaN|NAN))\Z",
    ),
)


@dataclass(frozen=True)
class Document:
    """What a file says, and where."""

    data: Any  # none, bool, int, float, str, and lists and mappings (with text as keys) of these
    # Line (from 1) of each key of a mapping and of each item of a list.
    lines: Mapping[KeyPath, int]

    def line(self, path: KeyPath) -> int | None:
        """Return the line of the value at ``path``, else of the innermost one around it."""
        for length in range(len(path), 0, -1):
            if (line := self.lines.get(path[:length])) is not None:
                return line
        return None


class _RefusedError(Exception):
    """The document holds something that this reader does not take."""

    def __init__(self, message: str, mark: yaml.Mark | None) -> None:
        super().__init__(message)
        self.mark = mark


class _Loader(yaml.SafeLoader):
    """PyYAML's parser with our plain scalars and with bounds on what a document may hold."""

    yaml_implicit_resolvers: dict[Any, Any] = {}  # noqa: RUF012  # PyYAML's own attribute

    def __init__(self, text: str) -> None:
        super().__init__(text)
        self._depth = 0
        self._num_nodes = 0

    def compose_node(self, parent: yaml.Node | None, index: int) -> yaml.Node | None:
        # Here rather than on the finished tree, because PyYAML composes by recursion and would
        # run out of stack, or of memory, before there is a tree.
        self._num_nodes += 1
        if self._depth >= MAX_DEPTH or self._num_nodes > MAX_VALUES:
            what = f"more than {MAX_VALUES} keys and values"
            if self._depth >= MAX_DEPTH:
                what = f"more than {MAX_DEPTH} levels of lists and mappings"
            event = cast("Any", self).peek_event()  # PyYAML's stubs leave it without a type.
            raise _RefusedError(f"{what}; a configuration has far fewer", event.start_mark)
        self._depth += 1
        try:
            return super().compose_node(parent, index)
        finally:
            self._depth -= 1


class _Dumper(yaml.SafeDumper):
    """PyYAML's writer with our plain scalars and without aliases."""

    yaml_implicit_resolvers: dict[Any, Any] = {}  # noqa: RUF012  # PyYAML's own attribute

    def ignore_aliases(self, data: Any) -> bool:
        del data
        return True

    def serialize(self, node: yaml.Node) -> None:
        _set_styles(node, depth=0)
        super().serialize(node)

    def represent_str(self, data: str) -> yaml.ScalarNode:
        # Only double quotes have escapes, without which line breaks of other kinds are lost.
        return self.represent_scalar(_STR, data, style=None if data.isprintable() else '"')


def _set_styles(node: yaml.Node, depth: int) -> int:
    """Put small lists and mappings within sections on one line; return the levels of ``node``."""
    if not isinstance(node, yaml.CollectionNode):
        return 0
    children = (
        [value for _, value in node.value] if isinstance(node, yaml.MappingNode) else node.value
    )
    height = 1 + max((_set_styles(child, depth + 1) for child in children), default=0)
    node.flow_style = depth >= 2 and height <= 2
    return height


_Dumper.add_representer(str, _Dumper.represent_str)


for _tag, _pattern in _PLAIN_SCALARS:
    _Loader.add_implicit_resolver(_tag, re.compile(_pattern), None)
    _Dumper.add_implicit_resolver(_tag, re.compile(_pattern), None)


class _Builder:
    """Turns PyYAML's nodes into plain data and notes the lines on the way."""

    def __init__(self) -> None:
        self.lines: dict[KeyPath, int] = {}
        self._num_values = 0

    def build(self, node: yaml.Node, path: KeyPath) -> Any:
        """Return the plain data of ``node``, which stands at ``path``."""
        # An alias gives the same node again, so a short document can stand for a huge one, or for
        # one that holds itself: both end at these bounds.
        self._num_values += 1
        if self._num_values > MAX_VALUES:
            raise _RefusedError(
                f"more than {MAX_VALUES} values, counting what aliases repeat", node.start_mark
            )
        if len(path) > MAX_DEPTH:
            raise _RefusedError(
                f"more than {MAX_DEPTH} levels of lists and mappings, or an alias to what it is in",
                node.start_mark,
            )
        if isinstance(node, yaml.MappingNode) and node.tag == _MAPPING:
            return self._mapping(node, path)
        if isinstance(node, yaml.SequenceNode) and node.tag == _SEQUENCE:
            items = []
            for index, item in enumerate(node.value):
                self.lines[(*path, index)] = item.start_mark.line + 1
                items.append(self.build(item, (*path, index)))
            return items
        if isinstance(node, yaml.ScalarNode):
            try:
                return _scalar(node)
            except _RefusedError as error:
                key = f"{dotted(path)}: " if path else ""
                raise _RefusedError(f"{key}{error}", error.mark) from None
        raise _RefusedError(
            f"the tag {node.tag} is not allowed; write plain values", node.start_mark
        )

    def _mapping(self, node: yaml.MappingNode, path: KeyPath) -> dict[str, Any]:
        mapping: dict[str, Any] = {}
        for key_node, value_node in node.value:
            if not isinstance(key_node, yaml.ScalarNode) or key_node.tag != _STR:
                is_scalar = isinstance(key_node, yaml.ScalarNode)
                what = f"{key_node.value:.80}" if is_scalar else "a list or mapping"
                raise _RefusedError(
                    f"{what} stands as a key, which only text may; if it is meant, quote it",
                    key_node.start_mark,
                )
            key = _scalar(key_node)
            self._num_values += 1
            key_path = (*path, key)
            line = key_node.start_mark.line + 1
            if key in mapping:
                first = self.lines[key_path]
                where = f"on line {line}" if first == line else f"on lines {first} and {line}"
                raise _RefusedError(
                    f"the key {dotted(key_path)} stands twice, {where}; keep one",
                    key_node.start_mark,
                )
            self.lines[key_path] = line
            mapping[key] = self.build(value_node, key_path)
        return mapping


def _scalar(node: yaml.ScalarNode) -> Any:
    """Return the value of a scalar: None, bool, int, float or str."""
    text: str = node.value
    if node.tag == _STR:
        # An escape ("\\ud800") can make half a character, which no file or terminal takes.
        if any("\ud800" <= character <= "\udfff" for character in text):
            raise _RefusedError(f"{brief(text)} holds half a character", node.start_mark)
        return text
    if node.tag == _AMBIGUOUS:
        raise _RefusedError(
            f"{text:.80} means different things to different YAML readers; write a number in plain"
            " decimal digits, true or false, or put it in quotes to mean text",
            node.start_mark,
        )
    # An explicit tag (!!int abc) arrives here without having matched a pattern.
    patterns = dict(_PLAIN_SCALARS)
    if node.tag not in patterns or re.match(patterns[node.tag], text) is None:
        raise _RefusedError(
            f"the tag {node.tag} is not allowed on {brief(text)}; write plain values",
            node.start_mark,
        )
    if node.tag == _NULL:
        return None
    if node.tag == _BOOL:
        return text.lower() == "true"
    if node.tag == _INT:
        # The length is checked first: converting a long row of digits takes quadratic time.
        value = int(text, 16 if text.startswith("0x") else 10) if len(text) <= 40 else 2**63
        if not -(2**63) <= value < 2**63:
            raise _RefusedError(
                f"{text:.80} does not fit into 64 bits; the limit is {2**63 - 1}", node.start_mark
            )
        return value
    number = float(text) if text.lstrip("+-")[:2].lower() not in (".i", ".n") else float("nan")
    if not abs(number) < float("inf"):
        raise _RefusedError(f"{text:.80} is not a finite number", node.start_mark)
    return number


def read(content: bytes, name: str) -> Document:
    """Read one YAML document in UTF-8; messages call it by its ``name``, usually its path.

    Raises ConfigurationError if this is no YAML, or holds what this reader does not take; the
    message has the line and the column.
    """
    if len(content) > MAX_BYTES:
        raise ConfigurationError(f"{name}: over {MAX_BYTES} bytes; a configuration has far fewer")
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = content.count(b"\n", 0, error.start) + 1
        raise ConfigurationError(
            f"{name}, line {line}: not UTF-8 text (byte 0x{content[error.start]:02x} at offset"
            f" {error.start}); save the file as UTF-8"
        ) from None
    builder = _Builder()
    try:
        node = _Loader(text).get_single_node()
        data = None if node is None else builder.build(node, ())
    except _RefusedError as error:
        raise ConfigurationError(f"{name}{_place(error.mark)}: {error}") from None
    except yaml.reader.ReaderError as error:
        line = text.count("\n", 0, error.position) + 1
        raise ConfigurationError(
            f"{name}, line {line}: not YAML: the character U+{ord(text[error.position]):04X} is not"
            " allowed"
        ) from None
    except yaml.MarkedYAMLError as error:
        context = f" ({error.context})" if error.context else ""
        place = _place(error.problem_mark or error.context_mark)
        raise ConfigurationError(f"{name}{place}: not YAML: {error.problem}{context}") from None
    return Document(data, builder.lines)


def _place(mark: yaml.Mark | None) -> str:
    """Return a mark as the words that follow the name of the file."""
    return "" if mark is None else f", line {mark.line + 1}, column {mark.column + 1}"


def write(data: Mapping[str, Any]) -> str:
    """Write plain data as YAML that :func:`read` gives back unchanged.

    Small lists and mappings within the sections are on one line.
    """
    return yaml.dump(data, Dumper=_Dumper, sort_keys=False, allow_unicode=True, width=100)
