"""JSON and YAML as people write them: recipes, symmetry tables, models_info.json. Bounded before it is built.

A few lines of YAML whose aliases refer to each other stand for billions of values, and a few kilobytes of brackets for
a tree deeper than Python's stack: what exceeds the limits is refused by its size, not by running out of memory.
"""

from __future__ import annotations

import json
import reprlib
from collections.abc import Hashable
from pathlib import Path
from typing import Any

import yaml

from synthetless.errors import UserError
from synthetless.io.files import read_bytes, unique_keys

MAX_BYTES = 16 * 2**20
MAX_DEPTH = 64
MAX_VALUES = 500_000


def read_document(path: Path) -> Any:
    """The content of a JSON or YAML file; None if it is empty.

    Raises:
        UserError: it cannot be read, is neither JSON nor YAML, is too large or too deep, or names a key twice.
    """
    data = read_bytes(path, MAX_BYTES)
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise UserError(f"{path}: is not UTF-8 text ({error.reason} at byte {error.start})") from None
    return parse_document(text, str(path))


def parse_document(text: str, name: str) -> Any:
    """The content of a JSON or YAML text, which an error calls by this name; errors as in ``read_document``."""
    try:
        return json.loads(text, object_pairs_hook=unique_keys)  # first: YAML 1.1 reads 1e-06 as a word
    except json.JSONDecodeError:
        pass
    except RecursionError:
        raise UserError(f"{name}: is nested deeper than {MAX_DEPTH} levels") from None
    except ValueError as error:
        raise UserError(f"{name}: {error}") from None
    try:
        return _Loader(text).bounded()
    except _RefusedError as error:
        raise UserError(f"{name}: {error}") from None
    except (yaml.YAMLError, RecursionError) as error:
        raise UserError(f"{name}: neither JSON nor YAML ({' '.join(str(error).split())})") from None
    except (ValueError, TypeError, OverflowError) as error:  # such as the 31st of February
        raise UserError(f"{name}: holds a value that YAML cannot read ({' '.join(str(error).split())})") from None


def shown(value: object) -> str:
    """A foreign value, short enough for a message of one line."""
    short = reprlib.Repr()
    short.maxstring = short.maxother = 60
    return short.repr(value)


class _RefusedError(Exception):
    """What the message says."""


class _Loader(yaml.SafeLoader):
    """Safe YAML that refuses a key given twice, of which plain YAML silently takes the last."""

    def __init__(self, text: str) -> None:
        super().__init__(text)
        self._depth = 0

    def bounded(self) -> Any:
        """The only document of the stream."""
        try:
            node = self.get_single_node()
            if node is None:
                return None
            self._count(node, {}, set())
            return self.construct_document(node)
        finally:
            self.dispose()

    def compose_node(self, parent: yaml.Node | None, index: Any) -> yaml.Node | None:
        self._depth += 1
        if self._depth > MAX_DEPTH:
            raise _RefusedError(f"is nested deeper than {MAX_DEPTH} levels")
        node = super().compose_node(parent, index)
        self._depth -= 1
        return node

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Hashable, Any]:
        keys = [key.value for key, _ in node.value if isinstance(key, yaml.ScalarNode)]
        if repeated := next((key for key in keys if keys.count(key) > 1), None):
            raise _RefusedError(f"{shown(repeated)} is listed twice")
        return super().construct_mapping(node, deep)

    def _count(self, node: yaml.Node, counts: dict[int, int], open_nodes: set[int]) -> int:
        """How many values a node stands for, aliases written out."""
        if id(node) in open_nodes:
            raise _RefusedError("has a value that contains itself")
        if id(node) not in counts:
            open_nodes.add(id(node))
            count = 1
            for child in _children(node):
                count += self._count(child, counts, open_nodes)
                if count > MAX_VALUES:
                    raise _RefusedError(f"stands for more than {MAX_VALUES} values, its aliases written out")
            open_nodes.remove(id(node))
            counts[id(node)] = count
        return counts[id(node)]


def _children(node: yaml.Node) -> list[yaml.Node]:
    if isinstance(node, yaml.MappingNode):
        return [part for pair in node.value for part in pair]
    return list(node.value) if isinstance(node, yaml.SequenceNode) else []
