"""Definitions read from generated classes, against those that ROS ships as files and that rosbags has of Kilted."""

from __future__ import annotations

import json

import pytest
from rosbags.typesys import Stores, get_typestore

from bridge.sources.ros2.graph import Graph
from rosbridge_eth.capture import DefinitionError, Wire, decoder_for, normalised_type_name, read_definition
from rosbridge_eth.robot.sources.ros2.rclpy_parts import definition_text

pytestmark = pytest.mark.service
PACKAGES = (
    "action_msgs", "builtin_interfaces", "geometry_msgs", "lifecycle_msgs", "nav_msgs", "rcl_interfaces",
    "rosgraph_msgs", "sensor_msgs", "service_msgs", "std_msgs", "test_msgs", "type_description_interfaces",
    "unique_identifier_msgs",
)  # fmt: skip

ALL = f"""
import importlib, json, sys
from pathlib import Path
from rosbridge_eth.robot.sources.ros2.rclpy_parts import definition_text
found = {{}}
for package in {PACKAGES!r}:
    module = importlib.import_module(package + ".msg")
    for name, generated in vars(module).items():
        if hasattr(generated, "SLOT_TYPES"):
            file = Path(sys.prefix, "share", package, "msg", name + ".msg")
            found[f"{{package}}/msg/{{name}}"] = [
                definition_text(f"{{package}}/msg/{{name}}"), file.read_text() if file.exists() else None
            ]
print(json.dumps(found))
"""


@pytest.fixture(scope="module")
def installed(python, tmp_path_factory) -> dict[str, list[str | None]]:
    from contextlib import ExitStack

    with ExitStack() as ends:
        return json.loads(Graph(python, 0, tmp_path_factory.mktemp("ros2"), ends).run(ALL))


def spelled(fields):
    """`char` is an alias of `uint8` in the MSG format of ROS 2; `byte` stays apart."""
    return [(name, json.loads(json.dumps(description).replace('"char"', '"uint8"'))) for name, description in fields]


def test_they_are_those_that_rosbags_has(installed):
    known = get_typestore(Stores.ROS2_KILTED).fielddefs
    compared = 0
    for name, (text, _) in installed.items():
        if name in known:
            try:
                definition = read_definition(name, text)
            except DefinitionError:
                continue
            compared += 1
            for part, fields in definition.fields.items():
                expected = [field for field in known[part][1] if field[0] != "structure_needs_at_least_one_member"]
                assert spelled(fields) == spelled(expected), part
    assert compared > 80


def test_they_are_those_in_the_files_that_ros_ships(installed):
    """Of each type its own fields; those of a package that rosbags does not know among them."""
    compared = 0
    for name, (text, file) in installed.items():
        if file is None or "wstring" in file:
            continue
        own = text.split("=" * 80)[0]
        lines = [line for line in map(str.strip, own.splitlines()) if line]
        shipped = [normal(name, line.split("#")[0].split()) for line in file.splitlines()]
        assert [normal(name, line.split()) for line in lines] == [pair for pair in shipped if pair], name
        compared += 1
    assert compared > 80


def normal(owner: str, words: list[str]) -> tuple[str, str] | None:
    """Type and name of a line without constants and defaults, the type in full."""
    if len(words) < 2 or "=" in words[1] or (len(words) > 2 and words[2].startswith("=")):
        return None
    kind = {"char": "uint8", "Header": "std_msgs/msg/Header"}.get(words[0], words[0])
    base, bracket, count = kind.partition("[")
    base = base if base != "char" else "uint8"
    if base[0].isupper():
        base = f"{owner.rpartition('/')[0]}/{base}"
    if "/" in base:
        base = normalised_type_name(base)
    return base + bracket + count, words[1]


def test_what_is_refused_is_told_by_name(installed):
    refused = {}
    for name, (text, _) in installed.items():
        try:
            read_definition(name, text)
        except DefinitionError as error:
            refused[name.removeprefix("test_msgs/msg/")] = str(error)
    assert "wstring" in refused.pop("WStrings")
    assert all("is an array of empty messages" in reason for reason in refused.values())
    assert refused.keys() == {
        "Arrays", "BoundedPlainSequences", "BoundedSequences", "MultiNested", "UnboundedSequences",
    }  # fmt: skip


# Without ROS: what rosidl's description looks like is known from the ones above.


def of_kind(kind: str, **attributes):
    return type(kind, (), attributes)()


class Inner:
    SLOT_TYPES = (of_kind("BoundedString", maximum_size=5), of_kind("BasicType", typename="octet"))

    @staticmethod
    def get_fields_and_field_types():
        return {"name": "string<5>", "flags": "octet"}


class Outer:
    INNER = of_kind("NamespacedType", namespaced_name=lambda self: ("own_msgs", "msg", "Inner"))
    SLOT_TYPES = (
        of_kind("Array", value_type=INNER, size=2),
        of_kind("BoundedSequence", value_type=of_kind("BasicType", typename="double"), maximum_size=3),
        of_kind("UnboundedSequence", value_type=of_kind("UnboundedString")),
        INNER,
    )

    @staticmethod
    def get_fields_and_field_types():
        return {"pair": "", "numbers": "", "words": "", "one": ""}


def test_a_class_is_written_out_with_its_parts_once():
    classes = {"own_msgs/msg/Outer": Outer, "own_msgs/msg/Inner": Inner}
    text = definition_text("own_msgs/msg/Outer", classes.__getitem__)
    assert text == (
        "own_msgs/Inner[2] pair\nfloat64[<=3] numbers\nstring[] words\nown_msgs/Inner one\n"
        + "=" * 80
        + "\nMSG: own_msgs/Inner\nstring<=5 name\nbyte flags\n"
    )
    assert decoder_for(Wire.CDR, "own_msgs/msg/Outer", text).type_name == "own_msgs/msg/Outer"
