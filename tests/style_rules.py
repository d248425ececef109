"""Rules of plain English, each with an example of what it finds and of what it leaves.

A rule finds what can be found automatically; absolutes ("never", "exactly") and long sentences are
left to a reader.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field

# Kinds of text, see `tests.style.read_texts`.
DOCSTRING, ENTRY, COMMENT, SETTING = "docstring", "entry", "comment", "setting"
MESSAGE, PAGE, NAME, TEST_NAME = "message", "page", "name", "test name"
VALUE = "value"  # a string of one word

NOTES = frozenset({DOCSTRING, COMMENT, SETTING})
PROSE = NOTES | {MESSAGE, PAGE, TEST_NAME}

BRITISH = (
    r"colour|favour(?!ite)|behaviour|neighbour|honour|grey(?!hound)|labell|modell(?!a)|travell|"
    r"cancell(?:ed|ing)|signall|channell|levell|centre|fibre|metres?\b|metred|licence|defence|offence|"
    r"judgement|artefact|catalogue|programmes?\b|whilst|amongst|learnt|spelt|burnt|analyse[ds]?\b|analysing|"
    r"(?:normal|minim|maxim|optim|initial|organ|recogn|general|special|summar|visual|quant|discret|vector|"
    r"parametr|standard|synthes|real|util|serial|token|random|local|penal|stabil|categor|character|custom|"
    r"emphas|equal|factor|final|ideal|linear|neutral|polar|priorit|regular|symbol|capital|digit|memor)"
    r"is(?:e[drs]?\b|ing\b|ation)"
)
RIDDLES = (
    "said|told|theirs|own|lay|lain|spun|turned|turns|turn|ours|mine|asked|heard|meant|"
    "Found|Ways|Way|Sight|Turn"
)


@dataclass(frozen=True)
class Rule:
    """A pattern that should not occur in texts of some kinds.

    Attributes:
        name: Printed with a finding.
        pattern: Regular expression; lines of a text are not indented, code in backticks is blank.
        finds: Texts in which it occurs.
        leaves: Similar texts in which it does not.
        advice: The wording to use instead.
        kinds: Kinds of text that the rule applies to.
    """

    name: str
    pattern: str
    finds: tuple[str, ...]
    leaves: tuple[str, ...]
    advice: str
    kinds: frozenset[str] = PROSE
    expression: re.Pattern[str] = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "expression", re.compile(self.pattern))


RULES = (
    Rule(
        "fragment",
        r"\A(?:Of|Their|Theirs|What|Whether)\b",
        ("Of the run.", "Their classes.", "Whether to resume.", "What the kernel takes."),
        ("Settings of the run.", "Class indices.", "True to resume."),
        "a noun phrase that names the thing; of a boolean: True if …",
        frozenset({ENTRY}),
    ),
    Rule(
        "summary",
        r"\A(?:What|Whether|Of|Their|Theirs)\b(?![^.]*\?)",
        ("Whether the file exists.", "What the tests share."),
        ("True if the file exists.", "Data of several tests."),
        "Return …, Render …; of a boolean: True if …",
        NOTES,
    ),
    Rule(
        "headless sentence",
        r"(?<=[.;]\s)(?:What|Whether|Whatever)\b(?![^.]*\?)",
        ("Masked pixels stay. What is masked counts in no score.",),
        ("Masked pixels stay. They count in no score.", "It stops. What now?"),
        "subject, verb, object",
    ),
    Rule(
        "listed word",
        r"\b(?:[Nn]obody|[Ll]ikewise|[Tt]old|[Ss]aid|[Tt]heirs|[Ss]pun|(?<![Dd]e)lain|lay)\b",
        ("Nobody waits.", "Photos likewise.", "a folder of theirs", "as was said", "where it lay"),
        ("The process does not wait.", "Photos too.", "a layer", "foretold"),
        "no one thing; also; stored; message; rotated",
    ),
    Rule(
        "no more",
        r"\b[Nn]o\smore\b(?!\s(?:\w+\s)?than)",
        ("The file is no more.", "reads no more images"),
        ("The file no longer exists.", "no more than three", "no more matches than"),
        "no longer, not … any more",
    ),
    Rule(
        "is none",
        r"\b(?:is|are|was|were|be|has|have|having|needs?|takes?|gives?|finds?)\snone\b(?!\sof)",
        ("if there is none", "A photo has none."),
        ("If it is None,", "None of them is read.", "is none of these"),
        "is not …, has no <noun>",
    ),
    Rule(
        "is no",
        r"(?<!\b[Tt]here\s)\b(?:is|are|was|were)\sno\s"
        r"(?!(?:longer|more|less|larger|smaller|better|worse|faster|slower|later|higher|lower)\b)\w",
        ("The file is no image.", "These are no labels."),
        (
            "The file is not an image.",
            "There is no file.",
            "is no longer read",
            "is no larger than",
        ),
        "is not a …",
    ),
    Rule(
        "software that speaks",
        r"\b(?:says|tells|asks|knows|believes|judges|judged)\b",
        ("The file says so.", "The caller knows it."),
        ("The file contains it.", "a known camera", "If asked,"),
        "returns, prints, queries, contains, estimates, selects, reads",
    ),
    Rule(
        "score",
        r"\b(?:have|has|had)\s\d+(?:\.\d+)?\s*(?:%\s)?(?:mIoU|mAcc)",
        ("Panoramas have 87.3 mIoU.",),
        ("Panoramas score 87.3 mIoU.", "The table has 3 rows."),
        "score 87.3 mIoU",
    ),
    Rule(
        "phrase",
        r"\b(?:as\sbefore|since\sthen|of\sthen|that\swhich|those\swhich|made\srooms|of\sHugging\sFace|"
        r"(?:turned|rotated)\s(?:in\s)?any\sway|of\s(?:one's|the\suser's)\sown)\b",
        (
            "reads as before",
            "figures of then",
            "that which remains",
            "networks of Hugging Face",
            "rotated in any way",
            "a config of one's own",
        ),
        ("just before", "the rest", "networks from Hugging Face", "your own config"),
        "unchanged; the rest; synthetic rooms; from …; arbitrary rotation; user-defined",
    ),
    Rule(
        "British spelling",
        rf"(?i){BRITISH}",
        ("grey", "labelled", "the centre", "normalises", "2 metres", "a licence"),
        (
            "gray",
            "labeled",
            "the center",
            "normalizes",
            "2 meters",
            "metrics",
            "promises",
            "raised",
        ),
        "American spelling",
        PROSE | {NAME, VALUE},
    ),
    Rule(
        "riddle",
        rf"\A_*(?:{RIDDLES})_*\Z",
        ("said", "_told", "theirs", "Found"),
        ("message", "owner", "overlay", "returned", "found"),
        "a name that says what it holds: composed, user_overrides, rotated",
        frozenset({NAME}),
    ),
    Rule(
        "test name",
        r"\A(?:what|whether|of)\s|\A\S+(?:\s\S+)?\Z",
        ("what is no stage is refused", "scores", "other formats"),
        ("unknown stages are refused", "scores are finite"),
        "a sentence of three words or more: subject and verb",
        frozenset({TEST_NAME}),
    ),
)
