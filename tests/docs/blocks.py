"""What stands in the code blocks of a page, and how each kind is run."""

from __future__ import annotations

import doctest
import re
import shlex
from dataclasses import dataclass
from pathlib import Path

__all__ = ["DOCS", "ROOT", "Block", "Command", "blocks", "commands", "matches", "pages"]

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"
_FENCE = re.compile(r"^```[ ]*(\w*)([^\n]*)\n(.*?)^```[ ]*$", flags=re.MULTILINE | re.DOTALL)


@dataclass(frozen=True, kw_only=True)
class Block:
    """A fenced block: its language, the file that its title names, its text and the line where it begins."""

    language: str
    title: str
    text: str
    line: int


@dataclass(frozen=True, kw_only=True)
class Command:
    """A line after ``$``, and the output that the page shows under it."""

    words: list[str]
    shown: str


def pages() -> list[Path]:
    """Every page of the documentation, and the README."""
    return [*sorted(DOCS.rglob("*.md")), ROOT / "README.md"]


def blocks(page: Path) -> list[Block]:
    """The fenced blocks of a page, in order."""
    text = page.read_text(encoding="utf-8")
    found = []
    for match in _FENCE.finditer(text):
        title = re.search(r'title="([^"]+)"', match[2])
        line = text.count("\n", 0, match.start()) + 1
        found.append(Block(language=match[1], title=title[1] if title else "", text=match[3], line=line))
    return found


def commands(block: Block) -> list[Command]:
    """The commands of a console block, those joined by ``&&`` one by one."""
    found: list[Command] = []
    for entry in re.split(r"^\$ ", block.text, flags=re.MULTILINE)[1:]:
        line, _, shown = entry.partition("\n")
        parts = [shlex.split(part, comments=True) for part in line.split("&&")]
        found += [Command(words=words, shown="") for words in parts[:-1]]
        found.append(Command(words=parts[-1], shown=shown))
    return found


def matches(shown: str, printed: str) -> bool:
    """Whether the page shows what was printed; ``...`` stands for anything, and nothing for any output."""
    if not shown.strip():
        return True
    check = doctest.OutputChecker()
    return check.check_output(shown, printed, doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE)
