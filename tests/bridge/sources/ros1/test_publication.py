"""A publisher's header: md5 sums as genpy computes them, and which decoder follows."""

from __future__ import annotations

import contextlib
import io
import json
import subprocess
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from bridge.sources.ros1.graph import SYSTEM_PYTHON
from rosbridge_eth.capture import DefinitionError, Wire, decoder_for
from rosbridge_eth.errors import SourceError
from rosbridge_eth.robot.sources.ros1.api import Refusal
from rosbridge_eth.robot.sources.ros1.tcpros import read_decoder, read_header, request_header

STRING = {"type": "std_msgs/String", "md5sum": "992ce8a1687cec8c8bd883ec73ca41d1", "message_definition": "string data"}


@pytest.fixture(scope="module")
def types(require):
    require("rosmaster")
    run = subprocess.run(
        [SYSTEM_PYTHON, "-B", Path(__file__).with_name("genpy_sums.py")], capture_output=True, text=True, check=True
    )
    return [json.loads(line) for line in run.stdout.splitlines()]


@pytest.mark.service
def test_every_type_that_debian_ships_has_the_sum_that_genpy_gives_it(types):
    assert len(types) > 100
    for name, text, md5 in types:
        decoder = read_decoder({"type": name, "md5sum": md5, "message_definition": text})
        assert decoder.type_name == name.replace("/", "/msg/")


@pytest.mark.service
def test_a_type_of_noetic_needs_no_definition(types):
    for name, text, md5 in types:
        if not name.startswith(("std_msgs/", "nav_msgs/")):
            continue
        decoder = read_decoder({"type": name, "md5sum": md5, "message_definition": ""})
        assert decoder.fields == decoder_for(Wire.ROS1, name, text).fields


# The wiki's own example of constants, and spaces where people put them; the sums are genpy's (generate_dynamic).
TRICKY = "byte OK=0\nbyte FAILED = 1   # a constant\nstring NOTE= \"a # b\"\nuint8[]  data # more\n\n  time[2] t\n"


@pytest.mark.service
def test_constants_spaces_and_comments_count_as_genpy_counts_them(require):
    require("rosmaster")
    program = (
        "import genpy.dynamic, sys; "
        "print(genpy.dynamic.generate_dynamic('a/B', sys.argv[1])['a/B']._md5sum)"
    )
    run = subprocess.run([SYSTEM_PYTHON, "-B", "-c", program, TRICKY], capture_output=True, text=True, check=True)
    assert decoder_for(Wire.ROS1, "a/B", TRICKY).definition.md5 == run.stdout.strip()


def test_other_fields_of_a_header_do_not_matter():
    decoder = read_decoder({**STRING, "callerid": "/talker", "latching": "1", "topic": "/t"})
    assert decoder.type_name == "std_msgs/msg/String"


def test_the_reasons_of_a_refusal_are_told():
    with pytest.raises(Refusal, match="the publisher refuses: go away"):
        read_decoder({"error": "go away"})
    with pytest.raises(DefinitionError, match=r"has the md5 sum 992c.*, not '0000"):
        read_decoder({**STRING, "md5sum": "0" * 32})
    with pytest.raises(DefinitionError, match="does not define a/msg/B"):
        read_decoder({**STRING, "type": "a/B", "message_definition": ""})


def test_a_subscriber_asks_for_any_type():
    header = read_header(io.BytesIO(request_header("/t", "/me")))
    assert header["type"] == header["md5sum"] == "*"


@given(
    st.dictionaries(st.sampled_from(["topic", "type", "md5sum", "message_definition", "latching", "callerid", "error"]),
                    st.text(max_size=60)),
    st.booleans(),
)  # fmt: skip
def test_any_header_is_a_decoder_or_refused(fields, complete):
    with contextlib.suppress(SourceError):
        read_decoder({**STRING, **fields} if complete else fields)


LINES = st.one_of(
    st.sampled_from(["uint8 a", "Header h", "Other o", "p/Other[] q", "string s = x", "time[3] t", "=" * 80,
                     "MSG: p/Other", "MSG: std_msgs/Header", "# c", "int32 X=1", "uint8[", "duration d # e"]),
    st.text(max_size=20),
)  # fmt: skip


@given(st.lists(LINES, max_size=12))
def test_any_definition_has_a_sum_or_is_refused(lines):
    text = "\n".join(lines)
    with contextlib.suppress(DefinitionError):
        assert len(decoder_for(Wire.ROS1, "p/Main", text).definition.md5) == 32
