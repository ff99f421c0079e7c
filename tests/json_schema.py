"""The part of JSON Schema that prompts.schema.json uses (draft 2020-12); an unknown keyword is a KeyError."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any

SILENT = {"$schema", "$defs", "title", "description", "default"}
TYPES: dict[str, Any] = {
    "object": dict,
    "array": list,
    "string": str,
    "boolean": bool,
    "number": (int, float),
    "null": type(None),
}


def is_valid(value: Any, schema: dict[str, Any], root: dict[str, Any] | None = None) -> bool:
    """Whether `value` follows `schema`; `root` is the document that references start from."""
    root = root or schema
    return all(keyword in SILENT or KEYWORDS[keyword](value, schema, root) for keyword in schema)


def _type(value: Any, schema: dict[str, Any], root: dict[str, Any]) -> bool:
    wanted = schema["type"]
    return isinstance(value, TYPES[wanted]) and (wanted == "boolean" or not isinstance(value, bool))


def _properties(value: Any, schema: dict[str, Any], root: dict[str, Any]) -> bool:
    inner = schema["properties"].items()
    return not isinstance(value, dict) or all(is_valid(value[n], s, root) for n, s in inner if n in value)


def _pattern(value: Any, schema: dict[str, Any], root: dict[str, Any]) -> bool:
    """`$` of ECMAScript: the very end, not before a last line feed."""
    return not isinstance(value, str) or re.search(schema["pattern"].replace("$", r"\Z"), value) is not None


def _number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool)


KEYWORDS: dict[str, Callable[[Any, dict[str, Any], dict[str, Any]], bool]] = {
    "$ref": lambda v, s, root: is_valid(v, root["$defs"][s["$ref"].removeprefix("#/$defs/")], root),
    "type": _type,
    "const": lambda v, s, root: v == s["const"] and isinstance(v, bool) == isinstance(s["const"], bool),
    "enum": lambda v, s, root: v in s["enum"],
    "anyOf": lambda v, s, root: any(is_valid(v, option, root) for option in s["anyOf"]),
    "minimum": lambda v, s, root: not _number(v) or v >= s["minimum"],
    "maximum": lambda v, s, root: not _number(v) or v <= s["maximum"],
    "maxLength": lambda v, s, root: not isinstance(v, str) or len(v) <= s["maxLength"],
    "maxItems": lambda v, s, root: not isinstance(v, list) or len(v) <= s["maxItems"],
    "pattern": _pattern,
    "items": lambda v, s, root: not isinstance(v, list) or all(is_valid(item, s["items"], root) for item in v),
    "required": lambda v, s, root: not isinstance(v, dict) or set(s["required"]) <= set(v),
    "properties": _properties,
    "additionalProperties": lambda v, s, root: not isinstance(v, dict) or set(v) <= set(s["properties"]),
}
