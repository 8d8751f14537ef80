"""Names, arguments, and what other packages add."""

import sys

import pytest
from other_package import install

from mdnum.errors import InputError
from mdnum.registry import Registry

GROUP = "mdnum.tests.rules"


class Rule:
    """A rule. More of it."""

    def __init__(self, width: str = "1"):
        self.width = int(width)


class Strict(Rule):
    """Needs its width."""

    def __init__(self, width):
        super().__init__(width)


class Parsed(Rule):
    """Reads its argument itself."""

    @classmethod
    def parse(cls, text: str):
        return cls(text.removeprefix("w"))


@pytest.fixture
def rules():
    """A registry with one value of each sort."""
    registry = Registry("rule", GROUP, kind=Rule)
    registry.add("plain", Rule)
    registry.add("strict")(Strict)
    registry.add("parsed", Parsed)
    registry.add("fixed", Rule("7"), description="Seven")
    registry.add("made", lambda: Rule("3"), description="Three")
    registry.add("later", "fractions:Fraction")
    return registry


@pytest.fixture
def installed(tmp_path, monkeypatch):
    """Installs packages into a folder that the test's process searches."""
    monkeypatch.syspath_prepend(tmp_path)
    modules = set(sys.modules)
    yield lambda *package: install(tmp_path, *package)
    for name in set(sys.modules) - modules:
        if (getattr(sys.modules[name], "__file__", None) or "").startswith(str(tmp_path)):
            del sys.modules[name]


def test_a_name_with_and_without_its_argument(rules):
    widths = {text: rules.parse(text).width for text in ("plain", "plain=4", " parsed=w5", "fixed", "made")}
    assert widths == {"plain": 1, "plain=4": 4, " parsed=w5": 5, "fixed": 7, "made": 3}
    assert rules.parse("later=2/3").denominator == 3
    assert list(rules) == ["plain", "strict", "parsed", "fixed", "made", "later"]
    assert "fixed" in rules and "fixt" not in rules
    told = [rules.description(name) for name in ("plain", "fixed")]
    assert told == ["A rule. More of it", "Seven"]
    with pytest.raises(ValueError, match="registered twice"):
        rules.add("plain", Rule)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("fixd", "'fixd' … fixed? … plain, strict"),
        ("x" * 10_000, "unknown rule"),
        ("fixed=3", "takes no argument"),
        ("made=3", "takes no argument"),
        ("strict", "needs an argument: strict=..."),
    ],
)
def test_what_is_not_there_is_an_error(rules, text, message):
    with pytest.raises(InputError) as caught:
        rules.parse(text)
    assert all(part in str(caught.value) for part in message.split(" … "))


def test_a_package_adds_a_value_that_is_imported_when_it_is_used(rules, installed):
    source = 'from test_registry import Rule\nclass Wide(Rule):\n    """Wide."""\n'
    installed("wide-rules", {"wide_rules": source}, {GROUP: {"wide": "wide_rules:Wide"}})
    # under pytest's importlib mode this module has another name than the package imports
    sys.modules["test_registry"] = sys.modules[__name__]
    assert list(rules)[-1] == "wide" and "wide_rules" not in sys.modules
    assert rules.parse("wide=9").width == 9
    told = rules.description("wide"), rules.package("wide"), rules.package("plain")
    assert told == ("Wide", "wide-rules", "mdnum")


@pytest.mark.parametrize(
    ("source", "point", "message"),
    [
        ("1 / 0", "broken:Rule", "bad-rules cannot be used: ZeroDivisionError"),
        ("x = 1", "broken:Rule", "bad-rules cannot be used: AttributeError"),
        ("class Other: pass", "broken:Other", "bad-rules cannot be used: TypeError"),
        ("", "missing:Rule", "bad-rules cannot be used: ModuleNotFoundError"),
    ],
)
def test_a_broken_package_is_named(rules, installed, source, point, message):
    installed("bad-rules", {"broken": source}, {GROUP: {"bad": point}})
    assert rules.parse("plain").width == 1
    with pytest.raises(InputError, match=message):
        rules.parse("bad")


def test_a_package_cannot_take_a_name_that_is_there(rules, installed):
    installed("first-rules", {}, {GROUP: {"plain": "anything:Rule"}})
    assert rules["plain"] is Rule
    for looked_up in (lambda: list(rules), lambda: rules["unknown"]):
        with pytest.raises(InputError, match=r"'plain' of .* first-rules .* by mdnum"):
            looked_up()


def test_two_packages_cannot_add_the_same_name(rules, installed):
    installed("first-rules", {}, {GROUP: {"wide": "first:Rule"}})
    installed("second-rules", {}, {GROUP: {"wide": "second:Rule"}})
    with pytest.raises(InputError, match=r"'wide' of .*-rules .* by .*-rules"):
        rules.parse("wide")
