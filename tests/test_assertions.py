"""Assertions hold codes, values and names: a sentence may be worded better, and no test fails for that."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

TESTS = Path(__file__).parent
#: Words that one string of an assertion may have: enough to tell two messages apart.
MOST = 4
#: What is quoted is a name, or input that a message repeats.
_QUOTED = re.compile(r"`[^`]*`|'[^' ]*'|\"[^\"]*\"|“[^”]*”|\\[A-Za-z]")
# neither ALL_CAPS nor CamelCase nor paths.with.dots, which are names, nor articles
_WORD = re.compile(r"(?!nan$|inf$|[A-Z][a-z]$)[A-Za-z][a-z]+(?:['’-][a-z]+)*")


def words(text: str) -> list[str]:
    """The words of a text that are neither names nor numbers; a regular expression is read like a text."""
    parts = (part.strip(".,:;?!()[]{}'\"\\*+^$|") for part in re.split(r"\s|\.\*", _QUOTED.sub(" ", text)))
    return [part for part in parts if _WORD.fullmatch(part)]


def strings(node: ast.AST) -> Iterator[tuple[int, str]]:
    """Line and text of those below a node, but for keys, which name numbers, and texts of several lines."""
    parts = node.values if isinstance(node, ast.JoinedStr) else [node]
    found = [part.value if isinstance(part, ast.Constant) else 0 for part in parts]
    if any(isinstance(part, str) for part in found):
        text = "".join(map(str, found))
        if "\n" not in text.rstrip():
            yield node.lineno, text  # type: ignore[attr-defined]
        return
    for child in ast.iter_child_nodes(node):
        if not (isinstance(node, ast.Subscript) and child is node.slice):
            yield from strings(child)


def assertions(function: ast.AST) -> Iterator[ast.expr]:
    """Conditions of `assert`, and patterns of `pytest.raises` and its like."""
    for node in ast.walk(function):
        if isinstance(node, ast.Assert):
            yield node.test
        elif isinstance(node, ast.Call):
            yield from (one.value for one in node.keywords if one.arg == "match")


def columns(names: list[str], table: ast.expr, used: set[str]) -> Iterator[ast.expr]:
    """What a table that is written out holds under the names that are used."""
    if isinstance(table, ast.Call) and isinstance(table.func, ast.Attribute) and table.func.attr == "items":
        table = table.func.value
    if isinstance(table, ast.Dict):
        rows = [[key, value] for key, value in zip(table.keys, table.values, strict=True) if key is not None]
    else:
        rows = getattr(table, "elts", [])
        if len(names) == 1:
            rows = [[row] for row in rows]
        else:  # tuples, or pytest.param(...)
            rows = [getattr(row, "elts", getattr(row, "args", [])) for row in rows]
    for row in rows:
        yield from (value for name, value in zip(names, row, strict=False) if name in used)


def expected(function: ast.FunctionDef) -> Iterator[ast.expr]:
    """What a function asserts, and what the tables and constants hold that its assertions name."""
    found = list(assertions(function))
    yield from found
    used = {node.id for each in found for node in ast.walk(each) if isinstance(node, ast.Name)}
    for mark in function.decorator_list:
        if isinstance(mark, ast.Call) and getattr(mark.func, "attr", "") == "parametrize":
            names = [part.strip() for _, text in strings(mark.args[0]) for part in text.split(",")]
            yield from columns(names, mark.args[1], used)
    for node in ast.walk(function):
        if isinstance(node, ast.For | ast.comprehension):
            names = [getattr(one, "id", "") for one in getattr(node.target, "elts", [node.target])]
            yield from columns(names, node.iter, used)
        elif isinstance(node, ast.Assign) and isinstance(node.value, ast.Constant | ast.JoinedStr):
            targets = [getattr(one, "id", "") for one in node.targets]
            yield from columns(targets, ast.Tuple([node.value]), used)


def handed_on(call: ast.AST, functions: dict[str, ast.FunctionDef]) -> Iterator[ast.expr]:
    """The arguments of a call that a function of the same file asserts."""
    if isinstance(call, ast.Call) and isinstance(call.func, ast.Name) and call.func.id in functions:
        function = functions[call.func.id]
        used = {
            node.id for each in assertions(function) for node in ast.walk(each) if isinstance(node, ast.Name)
        }
        names = [one.arg for one in function.args.args]
        yield from columns(names, ast.Tuple([ast.Tuple(call.args)]), used)
        yield from (one.value for one in call.keywords if one.arg in used)


def sentences(source: str) -> dict[int, str]:
    """Strings of assertions with more words than they may have, by line."""
    nodes = list(ast.walk(ast.parse(source)))
    functions = [node for node in nodes if isinstance(node, ast.FunctionDef)]
    asserted = [each for function in functions for each in expected(function)]
    named = {function.name: function for function in functions}
    asserted += [each for node in nodes for each in handed_on(node, named)]
    found = (pair for each in asserted for pair in strings(each))
    return {line: text for line, text in found if len(words(text)) > MOST}


def test_no_assertion_holds_a_sentence():
    files = sorted(TESTS.rglob("*.py"))
    found = [(path, sentences(path.read_text(encoding="utf-8"))) for path in files]
    named = [
        f"{path.relative_to(TESTS)}:{line}: {text!r}" for path, each in found for line, text in each.items()
    ]
    assert len(files) > 100 and not named, "\n".join(["Assert codes, values and names instead of:", *named])


SENTENCE = "the list has lost a pair"
WAYS = {
    "assert": f"assert {SENTENCE!r} in text",
    "f-string": f"assert f'{SENTENCE}' in text",
    "match": f"with pytest.raises(ValueError, match={SENTENCE!r}): f()",
    "constant": f"message = {SENTENCE!r}\n    assert message in text",
    "loop": f"for n, message in ((1, {SENTENCE!r}),):\n        assert message in f(n)",
    "one column": f"for message in [{SENTENCE!r}]:\n        assert message in text",
    "dictionary": f"for n, message in {{1: {SENTENCE!r}}}.items():\n        assert message in f(n)",
    "helper": f"def holds(part, text):\n        assert part in text\n    holds({SENTENCE!r}, text)",
    "comprehension": f"assert all(part in text for part in ({SENTENCE!r}, 'x'))",
}


@pytest.mark.parametrize("body", WAYS.values(), ids=WAYS)
def test_a_sentence_is_found_however_it_is_asserted(body):
    source = f"def test(text):\n    {body}\n"
    assert list(sentences(source).values()) == [SENTENCE]
    assert not sentences(source.replace(SENTENCE, "pair 3-4 is lost"))


def test_a_sentence_is_found_in_a_table_and_is_no_input():
    table = f"@pytest.mark.parametrize(('given', 'message'), [({SENTENCE!r}, {SENTENCE + '!'!r})])\n"
    body = "def test(given, message):\n    text = f(given)\n    assert message in text\n"
    assert sentences(table + body) == {1: f"{SENTENCE}!"}


def test_names_and_numbers_are_no_words():
    assert words(r"frame 20: atom 4 is at \(nan, nan\)") == ["frame", "atom", "is", "at"]
    assert words("`mdnum run` of 'float64' has MISSING rows, InputError: Ar in ase.io") == [
        "of", "has", "rows", "in",
    ]  # fmt: skip


def private_names(tree: ast.AST) -> Iterator[str]:
    """Names with a leading underscore that are imported from `mdnum.verbs` or read off a module of it."""
    modules: set[str] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("mdnum.verbs"):
            modules |= {one.asname or one.name for one in node.names}
            yield from (one.name for one in node.names if one.name.startswith("_"))
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id in modules:
            yield from [node.attr] * (node.attr.startswith("_") and not node.attr.startswith("__"))


@pytest.mark.parametrize(
    ("source", "found"),
    [
        ("from mdnum.verbs.fork import _numbers", ["_numbers"]),
        ("from mdnum.verbs import fork as f\nf._numbers(f.judge)", ["_numbers"]),
        ("from mdnum.verbs import frame\nfrom mdnum.md import kernel\nkernel._BLOCK, frame.finish", []),
    ],
)
def test_a_private_name_is_found(source: str, found: list[str]):
    assert list(private_names(ast.parse(source))) == found


def test_verbs_are_tested_by_what_they_offer():
    """A verb is its function, its judge, its page and its summary: what is inside may be written anew."""
    paths = sorted(TESTS.rglob("*.py"))
    found = {str(path.relative_to(TESTS)): [*private_names(ast.parse(path.read_text()))] for path in paths}
    assert len(found) > 150 and {path: names for path, names in found.items() if names} == {}
