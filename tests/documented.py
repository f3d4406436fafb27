"""The commands that README and docs give to type in a shell."""

import re
import shlex
from pathlib import Path

ROOT = Path(__file__).parent.parent
DOCUMENTS = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]


def commands_in(text: str) -> list[list[str]]:
    """
    :param text: of a page, whose shell blocks each begin in the folder of the checkout
    :return: the words of each command in them, continued lines joined, and then of those in sentences and tables
    """
    lines = []
    for block in re.findall(r"^```bash\n(.*?)^```", text, re.MULTILINE | re.DOTALL):
        lines += [*block.replace("\\\n", " ").splitlines(), *(["cd ."] if re.search("^cd ", block, re.MULTILINE) else [])]
    lines += _in_sentences(text)
    return [words for line in lines if (words := shlex.split(line, comments=True))]


def _in_sentences(text: str) -> list[str]:
    """:return: commands between single backticks; ``… --more`` is the last whole one with more to it"""
    lines, whole = [], ""
    for found in re.findall(r"(?<!`)`((?:python|make|…) [^`]+)`(?!`)", text):
        line = found.replace("\n", " ")
        # Neither those with a gap, nor those with a name in capitals for what the reader has
        if re.search(r"\.\.\.|.…|\b[A-Z]{2,}\b", line) or line.endswith((" -m", "sb3_gae.sweep")):
            continue
        if line.startswith("…"):
            lines.append(f"{whole}{line[1:]}")
        else:
            lines.append(line)
            whole = line
    return lines


#: those of each document, by its name, in its order
COMMANDS = {document.name: commands_in(document.read_text()) for document in DOCUMENTS}


def after_python(words: list[str]) -> list[str]:
    """:return: what an interpreter is given, ``-m`` and a module or a script at first; nothing if no interpreter is called"""
    place = next((number for number, word in enumerate(words) if Path(word).name == "python"), len(words))
    return words[place + 1 :]
