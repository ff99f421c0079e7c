"""Sanitizes a language model's text as a prompt, or rejects it with the reason. The text is never more than data.

Repaired: white space, quotes around the whole, list marks, Markdown emphasis, a final period, a view at the end.
Rejected: control, invisible and private characters, markup, links, paths, code, slots, talk about instructions.
"""

from __future__ import annotations

import re
import unicodedata

MAX_WORDS = 40
MIN_WORDS = 3
MAX_CHARACTERS = 400
"""Length limit of a description before parsing; 40 words are far shorter."""
MAX_RATIONALE_LENGTH = 300

BAD_CATEGORIES = ("Cc", "Cf", "Cs", "Co", "Cn")
"""Unicode categories: control, invisible (zero width, direction), surrogate, private, unassigned."""
EDGES = " \t\"'\u201c\u201d\u2018\u2019\u00ab\u00bb*_"
STOPS = ".;,: "
MARK = re.compile(r"^(?:[-*\u2022]|\(?\d{1,3}[.):])\s+")
VIEW_END = re.compile(r"[,;]?\s*(?:in\s+|from\s+)?(?:an?\s+|the\s+)?(?:front|side|back|rear|top|overhead) view$", re.I)
REFUSED = (
    ("markup", re.compile(r"<[^<>]{0,200}>|<\||\|>|&#?\w{1,10};|\[[^\]]*\]\(|^#{1,6} |```|`")),
    ("a link", re.compile(r"\w{2,10}://|\bwww\.|\bmailto:|\b(?:data|javascript|file):", re.I)),
    ("a path", re.compile(r"(?:^|[\s\"'(=,])(?:~|\.{1,2})?/[\w.]|\b[A-Za-z]:[\\/]|\\\\|\.\.[\\/]|\w+/\w+/\w+|\\\w")),
    (
        "code",
        re.compile(r"[{}$`]|&&|\|\||;\s*(?:rm|del|curl|wget|sudo|drop)\b|\b(?:import|def|class)\s+\w+\s*[(:]", re.I),
    ),
    (
        "talk about instructions",
        re.compile(
            r"\b(?:ignore|disregard|forget|override)\b.{0,40}\b(?:instructions?|prompts?|rules?|above|previous)\b"
            r"|\bsystem prompt\b|\bas an? (?:ai|language model|assistant)\b|\bi(?: cannot| can't| am sorry|'m sorry)\b"
            r"|\b(?:api|secret) key\b|\bpassword\b",
            re.I,
        ),
    ),
)
OTHER_VIEW = re.compile(
    r"\b(?:front|side|back|rear|top|overhead|bird's[- ]eye|bottom) view\b|\b(?:seen|viewed) from (?:the )?"
    r"(?:front|side|back|rear|behind|above|below|top)\b",
    re.I,
)


class UnusableText(Exception):
    """A text that cannot be repaired; the message is the reason, without text of the model. Internal to this
    package."""


def cleaned(text: str, min_words: int = MIN_WORDS) -> str:
    """Returns one clean line. Raises UnusableText."""
    text = plain(text, MAX_CHARACTERS)
    text = MARK.sub("", text).strip(EDGES).rstrip(STOPS).strip(EDGES)
    text = VIEW_END.sub("", text).rstrip(STOPS).strip(EDGES)
    words = len(text.split())
    if not min_words <= words <= MAX_WORDS:
        raise UnusableText(f"it has {words} words instead of {min_words} to {MAX_WORDS}")
    return text


def plain(text: str, longest: int) -> str:
    """Returns one line of plain words. Raises UnusableText for any other content."""
    if len(text) > longest:
        raise UnusableText(f"it has {len(text)} characters, more than {longest}")
    text = unicodedata.normalize("NFKC", text)
    text = re.sub(r"\s+", " ", text).strip().replace("**", "").replace("__", "")
    bad = next((c for c in text if unicodedata.category(c) in BAD_CATEGORIES), None)
    if bad is not None:
        raise UnusableText(f"it holds the character U+{ord(bad):04X}")
    for name, pattern in REFUSED:
        if pattern.search(text):
            raise UnusableText(f"it holds {name}")
    return text


def cleaned_rationale(text: str) -> str:
    """Returns the model's reason as one clean line, empty if unusable."""
    try:
        return plain(text[:MAX_RATIONALE_LENGTH], MAX_RATIONALE_LENGTH)
    except UnusableText:
        return ""


def printable(text: str, longest: int) -> str:
    """Returns untrusted text as one bounded line, safe for a terminal."""
    text = re.sub(r"\s+", " ", text[: 4 * longest])
    text = "".join(c for c in text if unicodedata.category(c) not in BAD_CATEGORIES).strip()
    return text if len(text) <= longest else text[: longest - 1] + "\u2026"
