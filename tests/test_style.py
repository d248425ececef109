"""Words that the house style replaces, in code, comments, settings and pages."""

from __future__ import annotations

import re
from pathlib import Path

ROOT = Path(__file__).parents[1]
FOLDERS = ("docs", "configs", "tangent_train", "datamodules", "models", "studies", "benchmarks")

WORDS = {
    r"[Nn]obody|[Ll]ikewise|[Tt]heirs|[Ss]pun": "no one thing; also; rotated",
    r"no more(?! (?:\w+ )?than)": "no longer",
    r"(?:is|are|was|were|has|have) none(?! of)": "is None, has no …",
    r"as before|since then|made rooms|of Hugging Face": "unchanged; synthetic rooms; from …",
    r"(?:have|has) \d+(?:\.\d+)? (?:mIoU|mAcc)": "score 87.3 mIoU",
    r"(?:colour|behaviour|neighbour|grey(?!hound)|labell|centre|metre|licence|catalogue)\w*": (
        "American spelling"
    ),
    r"(?:normal|minim|maxim|optim|initial|organ|recogn|general|visual)is(?:e|ed|ing|ation)": (
        "American spelling"
    ),
}
ANY_WORD = re.compile(rf"\b(?:{'|'.join(WORDS)})\b")
IGNORED = re.compile(r"`[^`]*`|https?://\S+")


def test_listed_words_do_not_occur() -> None:
    found = []
    for folder in FOLDERS:
        for path in sorted((ROOT / folder).rglob("*")):
            text = path.read_text("utf-8") if path.suffix in (".py", ".md", ".yaml") else ""
            if not ANY_WORD.search(text):
                continue
            for number, line in enumerate(text.splitlines(), 1):
                shown = IGNORED.sub("", line)
                advice = [WORDS[w] for w in WORDS if re.search(rf"\b(?:{w})\b", shown)]
                found += [f"{path.relative_to(ROOT)}:{number}: {a}: {line.strip()}" for a in advice]
    assert not found, "\n".join(found)
