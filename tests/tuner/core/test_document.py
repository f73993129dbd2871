import re

import pytest

from tuner.core.errors import ConfigError
from tuner.core.shipped import configs_folder
from tuner.core.yaml_section import MAX_BYTES, commented, dump_yaml, read_yaml
from tuner.vehicle import read_vehicle, write_vehicle


def refusal(tmp_path, text):
    path = tmp_path / "x.yaml"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(ConfigError) as error:
        read_yaml(path)
    message = str(error.value)
    assert "\n" not in message
    assert message.startswith(str(path))
    return message


def test_numbers_and_words_are_those_of_yaml_1_2(tmp_path):
    path = tmp_path / "x.yaml"
    path.write_text(
        "{a: 1e-6, b: no, c: 010, d: 1:30, e: 2024-01-01, f: null, g: true, h: -.5, i: 3}"
    )
    assert read_yaml(path).data == {
        "a": 1e-6,
        "b": "no",
        "c": 10,
        "d": "1:30",
        "e": "2024-01-01",
        "f": None,
        "g": True,
        "h": -0.5,
        "i": 3,
    }


def test_an_empty_file_is_an_empty_mapping(tmp_path):
    path = tmp_path / "x.yaml"
    path.write_text("# nothing said\n")
    assert read_yaml(path).data == {}


def test_lines_of_keys_are_known(tmp_path):
    path = tmp_path / "x.yaml"
    path.write_text("a: 1\n\nb:\n  c:\n    - d: 2\n    - e: 3\n")
    lines = read_yaml(path).lines
    assert lines["a",] == 1
    assert lines["b", "c", 1, "e"] == 6


def test_words_that_look_like_numbers_come_back_as_words(tmp_path):
    path = tmp_path / "x.yaml"
    data = {"a": "1e-6", "b": "no", "c": "1:30", "d": "null", "e": [0.1, 1e-300, 1e22], "f": "x: y"}
    path.write_text(commented("two\nlines\x1b[2J\x00") + dump_yaml(data))
    assert path.read_text().startswith("# two\n# lines␛[2J␀\n")
    assert read_yaml(path).data == data


def test_line_breaks_of_unicode_come_back_from_a_vehicle_s_name(tmp_path):
    vehicle = read_vehicle(configs_folder() / "vehicles" / "hovergames.yaml")
    named = vehicle.replace(name="quad\x85of\u2028the lab\u2029")
    write_vehicle(named, tmp_path / "v.yaml", header=named.name)
    assert read_vehicle(tmp_path / "v.yaml") == named


def test_sections_have_a_line_for_each_key_and_deeper_values_one_line():
    assert dump_yaml({"a": {"b": {"c": [1, 2]}}}) == "a:\n  b: {c: [1, 2]}\n"


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("a: 1\nb: 2\na: 3\n", "line 3: key 'a' already stands in line 1"),
        ("a: [1, 2\nb: 3\n", "line 2"),
        ("a: &x [1, *x]\n", "alias inside its own anchor"),
        ("[" * 5000, "nested too deeply"),
        (b"\xff\xfe\x00", "not UTF-8"),
        ("a: !!python/object/apply:os.system [ls]\n", "line 1"),
        ("a: 1\n---\nb: 2\n", "line 2"),
        ("{[1, 2]: 3}\n", "a key is not a word"),
        ("a: " + "9" * 5000, "line 1: a number has 5000 digits; correct the YAML"),
        ("a: 1\n" + "#" * MAX_BYTES, "larger than 1 MB"),
        ("a\x00b: 1", "not YAML"),
    ],
)
def test_what_cannot_be_used_is_refused_in_one_line(tmp_path, text, expected):
    assert expected in refusal(tmp_path, text)


def test_aliases_that_multiply_are_refused_before_they_do(tmp_path):
    levels = ["a0: &a0 [1, 1, 1, 1, 1, 1, 1, 1, 1]"]
    levels += [f"a{n}: &a{n} [{', '.join([f'*a{n - 1}'] * 9)}]" for n in range(1, 12)]
    assert re.search("holds more than 100000 values", refusal(tmp_path, "\n".join(levels)))
    text = f"a: &a {'x' * 100_000}\nholdout: [{'*a, ' * 20_000}]\n"  # two gigabytes
    assert "holds more than 1 MB of text" in refusal(tmp_path, text)


def test_a_missing_file_and_a_folder_are_named(tmp_path):
    with pytest.raises(ConfigError, match="does not exist"):
        read_yaml(tmp_path / "gone.yaml")
    with pytest.raises(ConfigError, match="is a folder"):
        read_yaml(tmp_path)
