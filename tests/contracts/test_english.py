"""Documents, docstrings, comments and messages avoid phrases that are hard to read."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PACKAGES = ("agents", "envs", "estimator", "evaluation", "sim_configs", "experiments")
FOLDERS = (*PACKAGES, "src/slamgym", "examples", "benchmarks", "docs")
BETTER = {
    r"told (?:of|to|apart|that|the|beforehand)": "given; distinguished; reported",
    r"(?:is|are|was|were|been|be) told": "receives; is given; is reported",
    r"(?:it|that|which|file|log|table|signature|header|page|name) tells?": "shows",
    r"tells (?:how|what|which|when|whether|of|why)": "describes; reports; decides",
    r"of which": "a new sentence, or 'whose', or 'with'",
    r"such as that": "such as the one",
    r"by how (?:many|much) (?:times|more)": "factor; ratio",
    r"as (?:the|a) \w+ tells": "from the …",
    r"asked of": "requested from; required by",
    r"com(?:e|es|ing) to nothing": "is never confirmed; has no effect",
    r"not a bit (?:behind|of)": "nothing; does not change",
    r"dear(?:er|est)": "more expensive; higher cost",
    r"an? heir|heirs": "subclass",
    r"gives? way": "is replaced; moves aside",
    r"would not suffice": "is too small",
    r"should (?:these|those|they|it) not": "if … does not",
    r"too sure of (?:itself|themselves)": "overconfident",
    r"tells? the truth": "is consistent",
    r"leaves? (?:\w+ )?on the table": "loses",
    r"a door of its own": "a method of its own",
    r"of its own accord": "automatically",
    r"ought to": "should",
    r"besides other things": "among other things",
    r"the question how": "the size of; how",
    r"held against": "compared with",
    r"hang on what": "depend on what",
    r"to be had": "available",
    r"thereof|wherein|whence|whereof|therein": "of it; in which; where",
    r"is it that|be it": "whether",
    r"nought": "zero; nothing",
    r"at hand": "available",
    r"likeliest": "most likely",
    r"goes? on (?:after|with)": "continues after; continues with",
    r"wander(?:s|ed|ing)?|blindly": "drives at random; without feedback",
    r"what there is": "the available …",
    r"counted √dt times": "dt multiplies the variance",
    r"(?:is|are) of (?:another|none|no|one)": "belongs to; shows; has",
    r"nobody (?:names|says|knows|has driven|(?:has )?stopped)": "without …",
}
"""Regular expression, and what to write instead."""
BAD = re.compile(r"\b(?:" + "|".join(f"({bad})" for bad in BETTER) + r")\b", re.I)
LINE_END = re.compile(r"""["']?[ \t]*\n\s*(?:\#:?|>|\*)?\s*(?:f?["'](?!["']))?""")
"""The end of a line of prose, with the marks of a string, a comment or a list."""


def phrases_in(text):
    """Yield (phrase, better) of a text whose lines are joined."""
    for found in BAD.finditer(LINE_END.sub(" ", text)):
        yield found[0], list(BETTER.values())[found.lastindex - 1]


def is_checked(path):
    """Whether a file is a text of ours: not made by the build of the site."""
    made = {"_build", "generated", "learn"}.intersection(path.parts)
    suffixes = {".md", ".py", ".toml", ".html"}
    return path.suffix in suffixes and not made


@pytest.mark.parametrize("folder", ["", *FOLDERS])
def test_texts_avoid_phrases_that_are_hard_to_read(folder):
    files = ROOT.glob("*.md") if not folder else (ROOT / folder).rglob("*")
    found = [
        f"{path.relative_to(ROOT)}: {phrase!r}; better: {better}"
        for path in sorted(files)
        if is_checked(path)
        for phrase, better in phrases_in(path.read_text(encoding="utf-8"))
    ]
    assert not found, "\n".join(found)


@pytest.mark.parametrize(
    "text",
    [
        "a map of\nwhich little is known",
        "# as the log\n# tells",
        '"it is"\n    f"told of"',
        "Dearer steps",
    ],
)
def test_a_phrase_is_found_across_lines_and_in_any_case(text):
    assert list(phrases_in(text))


def test_plain_sentences_are_accepted():
    assert not list(phrases_in("The header lists which noise the filter assumes."))
