from __future__ import annotations

import pytest

from tests.style import PRODUCT, Text, find, find_in, read_texts
from tests.style_rules import RULES, Rule

MODULE = '''"""Whether it runs.

Masked pixels stay. What is masked is no
label, see `told`.
"""

# Nobody reads
# a colour.
RATE = 3  # What it costs.


def test_scores(ours: int) -> None:
    """Add.

    Args:
        ours: Of the run.
        rate (float): Their rate, more of
            which is elsewhere.

    Returns:
        Whether it worked.
    """
    raise ValueError(f"{ours} is no number")
'''
PAGE = """# Title

Nobody labels `a colour`, see [this](colour.md).

```bash
echo colour
```

A `span
of grey code` and
a colour.
"""


@pytest.mark.parametrize("rule", RULES, ids=[rule.name for rule in RULES])
def test_a_rule_finds_and_leaves_its_examples(rule: Rule) -> None:
    for text in rule.finds:
        assert rule.expression.search(text), text
    for text in rule.leaves:
        assert not rule.expression.search(text), text


def test_findings_in_a_module_have_their_line_and_rule() -> None:
    found = {tuple(finding.split(": ")[:2]) for finding in find(read_texts("tests/a.py", MODULE))}
    assert found == {
        ("tests/a.py:1", "summary"),
        ("tests/a.py:3", "headless sentence"),
        ("tests/a.py:3", "is no"),
        ("tests/a.py:7", "listed word"),
        ("tests/a.py:8", "British spelling"),
        ("tests/a.py:9", "summary"),
        ("tests/a.py:12", "riddle"),
        ("tests/a.py:12", "test name"),
        ("tests/a.py:16", "fragment"),
        ("tests/a.py:17", "fragment"),
        ("tests/a.py:21", "fragment"),
        ("tests/a.py:23", "is no"),
    }


def test_code_and_addresses_of_a_page_are_not_read() -> None:
    found = [finding.split(": ")[:2] for finding in find(read_texts("a.md", PAGE))]
    assert found == [["a.md:3", "listed word"], ["a.md:11", "British spelling"]]


def test_only_comments_of_a_config_are_read() -> None:
    config = "colour: grey  # What it is.\n# a centre\n"
    found = [finding.split(": ")[:2] for finding in find(read_texts("a.yaml", config))]
    assert found == [["a.yaml:1", "summary"], ["a.yaml:2", "British spelling"]]


def test_a_finding_shows_its_text_and_the_advice() -> None:
    (finding,) = find([Text("a.md", 2, "page", "Two\nmetres high.")])
    assert finding == "a.md:3: British spelling: 'Two metres high.' (American spelling)"


def test_the_product_follows_the_rules() -> None:
    found = find_in(PRODUCT)
    assert not found, "\n".join(found)
