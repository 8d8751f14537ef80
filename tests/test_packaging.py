"""Files that registries, package indexes and GitHub read are complete and agree with pyproject.toml."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import pytest
import yaml

ROOT = Path(__file__).parents[1]
PACKAGE: dict[str, Any] = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
PROJECT = PACKAGE["project"]
# in conda-forge's names, where they are others
CONDA = {"matplotlib": "matplotlib-base"}
GATE = (ROOT / ".ci" / "run").read_text(encoding="utf-8")


def loaded(*path: str) -> Any:
    return yaml.safe_load(ROOT.joinpath(*path).read_text(encoding="utf-8"))


def requirements(lines: list[str]) -> dict[str, str]:
    """Version ranges by lower-case name, of "name>=1" and "name >=1"."""
    parts = [re.fullmatch(r"([\w-]+) *(.*)", line) for line in lines]
    return {part[1].lower(): part[2] for part in parts if part}


# -- placeholders --------------------------------------------------------------------------------------


def placeholders(root: Path) -> dict[str, set[str]]:
    """Files by the placeholders in them; CONTRIBUTING.md, which lists them, and the tests are left out."""
    folders = (".ci", ".github", "packaging", "docs", "mdnum", "scripts", "examples", "demos", "systems")
    files = [file for folder in folders for file in (root / folder).rglob("*")]
    files += [root / name for name in ("README.md", "CHANGELOG.md", "CITATION.cff", "pyproject.toml")]
    kinds = {"", ".cff", ".j2", ".md", ".py", ".toml", ".yaml", ".yml"}
    found: dict[str, set[str]] = {}
    for file in files:
        made = {"__pycache__", "reference"} & set(file.parts)
        if file.is_file() and file.suffix in kinds and not made:
            for name in re.findall(r"placeholder-[a-z]+", file.read_text(encoding="utf-8")):
                found.setdefault(name, set()).add(file.relative_to(root).as_posix())
    return found


def test_contributing_lists_every_placeholder_and_where_it_is():
    rows = re.findall(
        r"^\| `(placeholder-[a-z]+)` \|[^|]+\| (.*) \|$", (ROOT / "CONTRIBUTING.md").read_text(), re.MULTILINE
    )
    listed = {name: set(re.findall(r"`([^`]+)`", files)) for name, files in rows}
    assert len(listed) > 4 and listed == placeholders(ROOT)


def test_a_placeholder_that_is_not_listed_is_found(tmp_path: Path):
    for name in ("README.md", "CHANGELOG.md", "CITATION.cff", "pyproject.toml"):
        (tmp_path / name).write_text("")
    (tmp_path / "packaging").mkdir()
    (tmp_path / "packaging" / "x.yaml").write_text("doi: placeholder-doi")
    assert placeholders(tmp_path) == {"placeholder-doi": {"packaging/x.yaml"}}


# -- PyPI ----------------------------------------------------------------------------------------------


def test_the_readme_of_an_index_has_absolute_links_alone():
    """The hook that writes it applies these substitutions in order, with `re.sub`."""
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    hook = PACKAGE["tool"]["hatch"]["metadata"]["hooks"]["fancy-pypi-readme"]
    for one in hook["substitutions"]:
        text = re.sub(one["pattern"], one["replacement"], text)
    targets = re.findall(r"\]\(([^)]+)\)", text)
    relative = [target for target in targets if urlsplit(target).scheme != "https"]
    assert len(targets) > 20 and not relative
    base = PROJECT["urls"]["Homepage"]
    assert "![Distance" in text and f"]({base}/raw/main/docs/figures/fork.svg)" in text
    assert f"]({base}/blob/main/docs/start.md)" in text


def test_the_source_distribution_has_what_its_tests_and_documents_read():
    included = set(PACKAGE["tool"]["hatch"]["build"]["targets"]["sdist"]["include"])
    assert {"mdnum", "systems", "tests", "docs", "packaging", ".ci", ".github", "CONTRIBUTING.md"} <= included
    assert all((ROOT / name).exists() for name in included)
    assert {"description", "license", "authors", "keywords", "classifiers", "urls"} <= PROJECT.keys()
    assert all(urlsplit(url).scheme == "https" for url in PROJECT["urls"].values())


def test_the_citation_agrees_with_the_package():
    citation = loaded("CITATION.cff")
    assert (str(citation["version"]), citation["license"]) == (PROJECT["version"], PROJECT["license"])
    assert citation["authors"] == PROJECT["authors"]
    assert citation["repository-code"] == PROJECT["urls"]["Homepage"]
    assert citation["url"] == PROJECT["urls"]["Documentation"]


# -- registries ----------------------------------------------------------------------------------------

# of https://mdakits.mdanalysis.org: what a file of its registry must have
REQUIRED = {
    "project_name": str, "authors": list, "maintainers": list, "description": str, "keywords": list,
    "license": str, "project_home": str, "documentation_home": str, "documentation_type": str,
    "src_install": list, "import_name": str, "python_requires": str, "mdanalysis_requires": str,
    "run_tests": list, "test_dependencies": list, "project_org": str,
}  # fmt: skip


def test_the_registry_of_mdanalysis_kits_has_every_required_key():
    kit = loaded("packaging", "mdakits", "metadata.yaml")
    assert {key: type(kit.get(key)) for key in REQUIRED} == REQUIRED
    assert all(kit[key] for key in REQUIRED)
    urls = PROJECT["urls"]
    assert (kit["project_home"], kit["documentation_home"]) == (urls["Homepage"], urls["Documentation"])
    assert kit["changelog"] == urls["Changelog"] and kit["license"] == PROJECT["license"]
    assert kit["python_requires"] == PROJECT["requires-python"]
    assert kit["mdanalysis_requires"] == requirements(PROJECT["dependencies"])["mdanalysis"]
    assert kit["documentation_type"] in ("UserGuide", "API", "README", "UserGuide + API")
    for command in kit["run_tests"][1:]:
        assert all((ROOT / word).exists() for word in command.split()[1:])


def test_the_recipe_for_conda_forge_has_the_dependencies_of_the_package():
    recipe = loaded("packaging", "conda-forge", "recipe.yaml")
    context = recipe["context"]
    assert recipe["schema_version"] == 1 and context["version"] == PROJECT["version"]
    assert f">={context['python_min']}" == PROJECT["requires-python"]
    run = requirements([line for line in recipe["requirements"]["run"] if not line.startswith("python ")])
    expected = requirements(PROJECT["dependencies"])
    assert run == {CONDA.get(name, name): versions for name, versions in expected.items()}
    host = requirements(recipe["requirements"]["host"][2:])
    assert host == requirements(PACKAGE["build-system"]["requires"])
    assert recipe["build"]["python"]["entry_points"] == [f"mdnum = {PROJECT['scripts']['mdnum']}"]
    about = recipe["about"]
    assert (about["summary"], about["license"]) == (PROJECT["description"], PROJECT["license"])


@pytest.mark.nightly
def test_the_recipe_for_conda_forge_is_rendered():
    stage0 = pytest.importorskip("rattler_build").Stage0Recipe
    (variant,) = stage0.from_file(ROOT / "packaging" / "conda-forge" / "recipe.yaml").render()
    rendered = variant.recipe().to_dict() if callable(variant.recipe) else variant.recipe.to_dict()
    assert rendered["build"]["noarch"] == "python"
    assert rendered["requirements"]["run"][0] == f"python {PROJECT['requires-python']}"
    assert rendered["source"][0]["url"].endswith(f"/mdnum-{PROJECT['version']}.tar.gz")


# -- GitHub --------------------------------------------------------------------------------------------


def steps(name: str) -> dict[str, list[str]]:
    """What is run by the jobs of a workflow, actions left out."""
    jobs = loaded(".github", "workflows", f"{name}.yml")["jobs"]
    return {job: [one["run"] for one in said["steps"] if "run" in one] for job, said in jobs.items()}


def test_workflows_run_what_the_scripts_run():
    files = {file.stem for file in (ROOT / ".github" / "workflows").iterdir()}
    assert files == {"gate", "nightly", "site", "packages"}
    assert steps("gate") == {"gate": [".ci/run"]}
    assert steps("packages") == {"packages": [".ci/packages dist"]}
    assert steps("nightly")["nightly"] == ["python -m pip install -e '.[test]'", ".ci/nightly"]
    install, build = steps("site")["build"]
    assert f'{install} && {build.removesuffix(" site")} "$work/site"' in GATE
    installed, links = steps("nightly")["links"]
    assert installed == install and links == build.replace("-W", "-b linkcheck").replace("site", "links")
    for name in files:
        said = loaded(".github", "workflows", f"{name}.yml")
        assert said["permissions"] == {"contents": "read"}
        assert all("timeout-minutes" in job for job in said["jobs"].values() if "run" in str(job["steps"]))
    for name in ("run", "nightly", "packages"):
        assert (ROOT / ".ci" / name).stat().st_mode & 0o111, f".ci/{name} cannot be executed"


def test_issues_ask_for_what_doctor_prints():
    forms = {
        file.stem: loaded(".github", "ISSUE_TEMPLATE", file.name)
        for file in (ROOT / ".github" / "ISSUE_TEMPLATE").glob("*.yml")
    }
    assert forms.pop("config") == {"blank_issues_enabled": False}
    assert forms.keys() == {"bug", "wrong-result", "question"}
    for name, form in forms.items():
        assert form["name"] and form["description"]
        fields = {one["id"]: one for one in form["body"]}
        assert (
            len(fields) == len(form["body"])
            and "`mdnum doctor --json`" in fields["doctor"]["attributes"]["label"]
        )
        assert all(
            one["type"] in ("textarea", "input") and one["attributes"]["label"] for one in fields.values()
        )
        assert fields["doctor"].get("validations", {}).get("required", False) == (name != "question")


# -- links ---------------------------------------------------------------------------------------------


def test_external_links_are_addresses():
    """Whether there is anything at them takes a network: see CONTRIBUTING.md."""
    pages = [*ROOT.glob("*.md"), *(ROOT / "docs").glob("*.md"), *(ROOT / "docs").glob("[!r]*/*.md")]
    targets = [
        (page.name, target)
        for page in pages
        for target in re.findall(r"\]\(<?([a-z]+:[^)\s>]*)", page.read_text(encoding="utf-8"))
    ]
    assert len(targets) > 15
    for page, target in targets:
        parts = urlsplit(target)
        assert parts.scheme == "https" and re.fullmatch(r"([a-z0-9-]+\.)+[a-z]{2,}", parts.netloc), (
            page,
            target,
        )
