"""The JSON Schema of the machine file: an editor underlines what daqsvc refuses, and nothing else."""

from __future__ import annotations

import functools
import json
import tomllib

import pytest
from guard.broken import spoilt
from pydantic import ValidationError
from support.machine_files import LAVAL, MACHINES
from support.paths import ROOT

from daqsvc.cli import main
from daqsvc.settings.json_schema import machine_schema, machine_schema_text
from daqsvc.settings.models import machine_file_model
from daqsvc.settings.schema import only_follows

pytestmark = pytest.mark.property
COMMITTED = ROOT / "docs" / "schemas" / "machine.schema.json"
SPECIMENS = sorted((ROOT / "tests" / "guard" / "specimens").rglob("*.toml"))
OF_AN_OTHER_DRIVER = "specimen-other.toml"


@functools.cache
def validator():
    """Importing jsonschema takes 1.5 s: whoever only collects does without."""
    from jsonschema import Draft7Validator

    return Draft7Validator(machine_schema())


def underlined(document):
    """Places of a document that an editor marks by the schema."""
    places = set()
    for error in validator().iter_errors(document):
        at = tuple(error.absolute_path)
        match error.validator:
            case "additionalProperties":
                places |= {(*at, key) for key in error.instance.keys() - error.schema["properties"].keys()}
            case "required":
                places |= {(*at, key) for key in error.validator_value if key not in error.instance}
            case "pattern" | "maxLength" if "propertyNames" in error.absolute_schema_path:
                places.add((*at, error.instance))
            case _:
                places.add(at)
    return places


def refused(document):
    """Places of a document that the models refuse, and those of them that only a validator of ours does."""
    try:
        machine_file_model().model_validate(document)
    except ValidationError as error:
        errors = [item for item in error.errors(include_url=False) if not only_follows(item, document)]
    else:
        return set(), set()
    places = {True: set(), False: set()}
    for item in errors:
        place = tuple(step for step in item["loc"] if step != "[key]")
        if item["type"] == "missing" and isinstance(place[-1], int):
            place = place[:-1]  # an array that is too short
        places["remedy" in item.get("ctx", {})].add(place)
    return places[False], places[True]


def test_the_committed_schema_is_the_one_of_the_code():
    remedy = "run python -m daqsvc.publish.schemas docs/schemas"
    assert COMMITTED.read_text(encoding="utf-8") == machine_schema_text(), remedy


def test_it_is_a_schema_itself():
    validator().check_schema(validator().schema)


def test_check_prints_it_without_a_machine_file(capsys):
    with pytest.raises(SystemExit) as ended:
        main(["check", "--schema"])
    assert ended.value.code == 0
    assert json.loads(capsys.readouterr().out) == machine_schema()


@pytest.mark.parametrize("folder", [MACHINES, ROOT / "daqsvc" / "examples" / "machines"], ids=str)
def test_nothing_is_underlined_in_the_examples(folder):
    files = sorted(folder.glob("*.toml"))
    assert files
    for file in files:
        assert underlined(tomllib.loads(file.read_text(encoding="utf-8"))) == set(), file


def test_nothing_is_underlined_in_files_that_have_every_key():
    for file in SPECIMENS:
        marked = underlined(tomllib.loads(file.read_text(encoding="utf-8")))
        # The schema knows the drivers that are installed.
        assert marked == ({("buses", "other", "driver")} if file.name == OF_AN_OTHER_DRIVER else set()), file


@pytest.mark.parametrize(
    ("old", "new", "place"),
    [
        ("noise_um", "noise_mu", ("pipeline", "rotor_bank", "noise_mu")),
        ("window_s = 0.5", 'window_s = "half"', ("pipeline", "levels", "window_s")),
        ("damping_ratio = 0.18 ", "damping_ratio = 18 ", ("machine", "rotor", "damping_ratio")),
        ('rule = "cusum"', 'rule = "cosum"', ("pipeline", "rotor_bank", "rule")),
        ('name = "probe-x"', 'name = "probe x"', ("sensors", 0, "name")),
        ("[mqtt]", "[mqttt]", ("mqttt",)),
    ],
)
def test_a_slip_is_underlined_where_it_is(old, new, place):
    text = LAVAL.read_text(encoding="utf-8")
    assert old in text
    assert place in underlined(tomllib.loads(text.replace(old, new, 1)))


@pytest.mark.parametrize(
    ("old", "new", "place"),
    [
        ("speed_rpm = 600.0", "speed_rpm = 0", ("machine", "speed_rpm")),
        (
            "sensitivity_mv_per_unit = 7.87",
            "sensitivity_mv_per_unit = 0",
            ("sensors", 0, "sensitivity_mv_per_unit"),
        ),
        ("length = 64", "length = 13", ("streams", "shaft", "layout", "length")),
        ("scale = 0.001", "scale = 0.0", ("streams", "shaft", "layout", "channels", 0, "scale")),
        ("[mqtt]", '[page]\nlisten = "x"\n[mqtt]', ("page", "listen")),
        ("[mqtt]", '[page]\nlisten = "127.0.0.1:99999"\n[mqtt]', ("page", "listen")),
        ("[mqtt]", '[page]\nlisten = "::1:9000"\n[mqtt]', ("page", "listen")),
        ("[mqtt]", '[page]\nproxies = ["abc"]\n[mqtt]', ("page", "proxies", 0)),
        ("[mqtt]", '[page]\nuser_header = "X User"\n[mqtt]', ("page", "user_header")),
    ],
)
def test_what_a_validator_of_ours_refuses_of_a_single_value_is_underlined(old, new, place):
    text = LAVAL.read_text(encoding="utf-8")
    assert old in text
    document = tomllib.loads(text.replace(old, new, 1))
    assert underlined(document) == {place} == refused(document)[1]


@pytest.mark.parametrize(
    "table",
    [
        'listen = "[::1]:8420"',
        'listen = "edge-1.example:08420"',
        'listen = "0.0.0.0:65535"',
        'proxies = ["127.0.0.1", "::1", "2001:db8::1"]',
        'user_header = "X-Remote-User"',
    ],
)
def test_addresses_that_are_taken_are_not_underlined(table):
    document = tomllib.loads(f"{LAVAL.read_text(encoding='utf-8')}\n[page]\n{table}\n")
    assert (underlined(document), refused(document)) == (set(), (set(), set()))


@pytest.mark.long
def test_it_underlines_what_the_models_refuse_and_nothing_else():
    """Every key of every kind of table misspelt, of another type, beyond its bounds, and left out."""
    texts = {file.name: file.read_text(encoding="utf-8") for file in (*MACHINES.glob("*.toml"), *SPECIMENS)}
    del texts[OF_AN_OTHER_DRIVER]
    found = 0
    for case in spoilt(texts):
        try:
            document = tomllib.loads(case.text)
        except tomllib.TOMLDecodeError:
            continue  # an inline table without its last key
        by_the_schema, (by_type, by_us) = underlined(document), refused(document)
        if case.name.startswith(("without ", "unknown ")):
            # What kind of table is meant, nobody knows then: the place of the key that tells it is enough.
            assert by_the_schema or not by_type, case.name
            continue
        assert by_type <= by_the_schema <= by_type | by_us, case.name
        found += len(by_type)
    assert found > 1000
