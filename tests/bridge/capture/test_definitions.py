"""Message definitions from strangers: what is legal is read, what is hostile never reaches rosbags' compiler."""

from __future__ import annotations

import contextlib
import hashlib
import sys
import time

import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_typestore

from rosbridge_eth.capture import (
    Conversion,
    DefinitionError,
    Restoration,
    Wire,
    decoder_for,
    decoder_for_known,
    read_definition,
)
from rosbridge_eth.capture.definitions import MAX_DEPTH, MAX_FIELDS, MAX_KEPT, MAX_TEXT, check_types, write_text

SEPARATOR = "=" * 80


def definition(*sections: str) -> str:
    first, *others = sections
    return "\n".join([first, *(f"{SEPARATOR}\nMSG: {other}" for other in others)])


@pytest.mark.parametrize("type_name", sorted(get_typestore(Stores.ROS1_NOETIC).fielddefs))
def test_every_type_of_noetic_is_read_as_rosbags_reads_it(type_name):
    store = get_typestore(Stores.ROS1_NOETIC)
    text, _ = store.generate_msgdef(type_name)
    read = read_definition(type_name, text)
    for name, fields in read.fields.items():
        expected = [field for field in store.fielddefs[name][1] if field[0] != "structure_needs_at_least_one_member"]
        assert fields == expected, name


@pytest.mark.parametrize("type_name", sorted(get_typestore(Stores.ROS2_HUMBLE).fielddefs))
def test_every_type_of_humble_is_read_as_rosbags_reads_it(type_name):
    store = get_typestore(Stores.ROS2_HUMBLE)
    text, _ = store.generate_msgdef(type_name, ros_version=2)
    if "wstring" in text:
        pytest.skip("a wstring is refused, see below")
    read = read_definition(type_name, text)
    for name, fields in read.fields.items():
        expected = [field for field in store.fielddefs[name][1] if field[0] != "structure_needs_at_least_one_member"]
        assert fields == expected, name


def test_what_people_write_in_definitions():
    text = (
        "# a comment\r\n\r\n"
        "int32 CONST=5   # not a field\n"
        "uint8 lower_case_constant = 1\n"
        'string QUOTE="it\'s # no comment; import os"\n'
        "float32 F=1e-3\n"
        "\tint32   spaced   \t # trailing\n"
        "int32 with_default 7\n"
        'string greeting "hello # world"\n'
        "string<=10 bounded\n"
        "string<=10[<=3] bounded_strings\n"
        "int32[<=5] at_most_five\n"
        "float64[9] nine\n"
        "bool[] any\n"
        "time stamp\n"
        "duration[2] two\n"
        "Header header\n"
        "Point near\n"
        "geometry_msgs/Point far\n"
        "float64[3] lambda\n"
        "@key\n"
    )
    full = definition(
        text,
        "my_pkg/Point\nint8 x",
        "geometry_msgs/Point\nfloat64 x",
        "std_msgs/Header\nuint32 seq\ntime stamp\nstring frame_id",
    )
    fields = dict(read_definition("my_pkg/Thing", full).fields["my_pkg/msg/Thing"])
    base, array, sequence = Nodetype.BASE, Nodetype.ARRAY, Nodetype.SEQUENCE
    assert fields == {
        "spaced": (base, ("int32", 0)),
        "with_default": (base, ("int32", 0)),
        "greeting": (base, ("string", 0)),
        "bounded": (base, ("string", 10)),
        "bounded_strings": (sequence, ((base, ("string", 10)), 3)),
        "at_most_five": (sequence, ((base, ("int32", 0)), 5)),
        "nine": (array, ((base, ("float64", 0)), 9)),
        "any": (sequence, ((base, ("bool", 0)), 0)),
        "stamp": (Nodetype.NAME, "builtin_interfaces/msg/Time"),
        "two": (array, ((Nodetype.NAME, "builtin_interfaces/msg/Duration"), 2)),
        "header": (Nodetype.NAME, "std_msgs/msg/Header"),
        "near": (Nodetype.NAME, "my_pkg/msg/Point"),
        "far": (Nodetype.NAME, "geometry_msgs/msg/Point"),
        "lambda": (array, ((base, ("float64", 0)), 3)),
    }


HOSTILE_TYPE_NAMES = [
    "",
    "Odometry",
    "a/b/c/d",
    "/etc/passwd",
    "a/../b",
    "a//b",
    "1a/B",
    "a/B'",
    'a/B"); import os; ("',
    "a/B\nimport os",
    "a/__import__",
    "a/b__c",  # would share a Python name with a/b/c
    "a/é",
    "a/" + "B" * 10_000,
    "_a/B",
]


@pytest.mark.parametrize("name", HOSTILE_TYPE_NAMES)
def test_a_type_name_that_is_none_is_refused(name):
    with pytest.raises(DefinitionError):
        read_definition(name, "int32 x")
    with pytest.raises(DefinitionError):
        read_definition("a/B", definition("int32 x", f"{name}\nint32 y"))


@pytest.mark.parametrize(
    "line",
    [
        "int32 x; import os",
        "int32 x\x00y",
        "int32 __class__",
        "int32 _x",
        "int32 1x",
        "int32 x'",
        "int32 é",
        "int32",
        "x",
        "int32[-1] x",
        "int32[0] x",
        "int32[1.5] x",
        "int32[0x10] x",
        "int32[99999999999] x",
        "int32[<=] x",
        "int32[2][2] x",
        "int32<=5 x",
        "float128 x",
        "wstring x",
        "long x",  # an unknown type of the same package
        "../x y",
        "std_msgs/Header h",  # not defined
        "a/b/c/d x",
        "int32 " + "x" * 1000,
        "string[9000] s",
        "uint8[2000000] u",
        "float64[200000] u",
        "@verbatim x",
        "int32 x\nint32 x",
        "int32 class\nint32 class_",
        "B again",
        "MSG: a/C",
        SEPARATOR,
        f"{SEPARATOR}\nint32 y",
        f"{SEPARATOR}\nIDL: a/msg/C\nmodule a {{}};",
        f"{SEPARATOR}\nMSG: a/B\nint64 other",  # the same type, otherwise
        f"time t\n{SEPARATOR}\nMSG: builtin_interfaces/Time\nint64 sec\nuint32 nanosec",
    ],
)
def test_a_line_that_is_no_field_is_refused(line):
    with pytest.raises(DefinitionError):
        read_definition("a/B", line)


def test_types_that_contain_themselves_are_refused():
    with pytest.raises(DefinitionError, match="contains itself"):
        read_definition("a/A", definition("B b", "a/B\nC[] c", "a/C\nA a"))


def test_deep_nesting_is_refused_and_reasonable_nesting_is_not():
    def nested(depth):
        return definition(
            *[("" if i == 0 else f"a/T{i}\n") + f"T{i + 1} x" for i in range(depth)], f"a/T{depth}\nint8 x"
        )

    read_definition("a/T0", nested(MAX_DEPTH))
    with pytest.raises(DefinitionError, match="deep"):
        read_definition("a/T0", nested(MAX_DEPTH + 1))


@pytest.mark.timeout(120)
@pytest.mark.parametrize("array", ["", "[]", "[1]"])
def test_what_is_read_can_be_captured_whatever_its_depth_and_width(array):
    deep = [("" if n == 0 else f"a/T{n}\n") + f"T{n + 1}{array} x" for n in range(MAX_DEPTH)]
    wide = [("" if n == 0 else f"a/T{n}\n") + "\n".join(f"T{n + 1}{array} x{m}" for m in range(7)) for n in range(4)]
    for levels in (deep, wide):
        decoder = decoder_for(Wire.ROS1, "a/T0", definition(*levels, f"a/T{len(levels)}\nuint8 x\nstring s"))
        raw = Restoration(decoder)
        message = decoder.decode(decoder.encode(raw.restore({}).message))
        data = Conversion(decoder).convert(message)
        assert decoder.encode(raw.restore(data).message) == decoder.encode(message)


def test_arrays_of_nothing_are_refused():
    # A count of 2**32 - 1 of them would take four bytes on the wire and all the memory there is.
    for array in ("E[] x", "E[5] x", "W[] x"):
        with pytest.raises(DefinitionError, match="empty"):
            read_definition("a/A", definition(array, "a/E\nint32 ONLY_A_CONSTANT=1", "a/W\nE inner"))
    assert read_definition("a/A", definition("E x", "a/E\n")).smallest["a/msg/A"] == 0


def test_fixed_arrays_may_not_multiply():
    # Each level is small; together they would unroll into 10**9 elements of generated work.
    with pytest.raises(DefinitionError, match="comes to more than"):
        read_definition("a/A", definition("B[1000] b", "a/B\nC[1000] c", "a/C\nstring[1000] s"))


def test_types_that_double_at_every_level_are_refused():
    # A few lines that would be written out as 2**30 fields.
    levels = [("" if n == 0 else f"a/T{n}\n") + f"T{n + 1} a\nT{n + 1} b" for n in range(30)]
    with pytest.raises(DefinitionError, match="comes to more than"):
        read_definition("a/T0", definition(*levels, "a/T30\nint8 x"))
    in_arrays = [level.replace(" a", "[] a").replace(" b", "[2] b") for level in levels]
    with pytest.raises(DefinitionError):
        read_definition("a/T0", definition(*in_arrays, "a/T30\nint8 x"))


def test_sizes_are_bounded():
    with pytest.raises(DefinitionError, match="without its comments"):
        read_definition("a/A", f'int32 x\nstring S="{"s" * MAX_KEPT}"')
    read_definition("a/A", f"int32 x\n# {'s' * MAX_KEPT}")
    with pytest.raises(DefinitionError, match="characters"):
        read_definition("a/A", "#" * (MAX_TEXT + 1))
    with pytest.raises(DefinitionError, match="fields"):
        read_definition("a/A", "\n".join(f"int8 x{i}" for i in range(MAX_FIELDS + 1)))
    with pytest.raises(DefinitionError, match="longer than"):
        read_definition("a/A", definition("int8 x", *[f"a/T{i}\nint8 x" for i in range(600)]))


def test_a_constant_s_text_never_reaches_generated_code():
    marker = "test_marker_that_must_not_exist"
    text = f'int32 x\nstring S="""\'); import sys; sys.{marker} = 1; (\'\n'
    decoder = decoder_for(Wire.ROS1, "a/Constants", text)
    assert decoder.decode(b"\x07\x00\x00\x00").x == 7
    assert not hasattr(sys, marker)
    assert decoder.typestore.fielddefs["a/msg/Constants"] == ([], [("x", (Nodetype.BASE, ("int32", 0)))])


def test_a_definition_is_kept_without_its_comments_and_with_its_constants():
    text = '# c\r\n\n int32 x # c\nstring S= a # b\nstring s # c\nbyte B=1 # c\n'
    kept = read_definition("a/B", text).text
    assert kept == "int32 x\nstring S= a # b\nstring s # c\nbyte B=1\n"
    assert read_definition("a/B", kept).text == kept


@pytest.mark.parametrize("store", [Stores.ROS1_NOETIC, Stores.ROS2_KILTED])
def test_what_is_written_from_a_tree_is_read_as_that_tree(store):
    ros1 = store is Stores.ROS1_NOETIC
    known = get_typestore(store)
    for type_name in known.fielddefs:
        if ros1 and type_name.startswith("builtin_interfaces/"):
            continue  # no messages there
        try:
            tree = read_definition(type_name, known.generate_msgdef(type_name, 1 if ros1 else 2)[0])
        except DefinitionError as error:
            assert "wstring" in str(error)
            continue
        text = write_text(type_name, tree.fields, ros1=ros1)
        assert "/msg/" not in text
        assert read_definition(type_name, text).fields == tree.fields
        if ros1 and not any(known.fielddefs[name][0] for name in tree.fields):  # no constants
            assert read_definition(type_name, text).md5 == tree.md5


@given(st.text(alphabet=st.sampled_from("ab/_1=[]<>#\"'\\; \n\t\x00é=int32stringtimeMSG:@()"), max_size=200))
@example("int32 x\n" + SEPARATOR)
@example("a b\n")
def test_any_text_is_a_definition_or_an_error(text):
    try:
        read = read_definition("pkg/Type", text)
    except DefinitionError:
        return
    for name, fields in read.fields.items():
        assert all(part.isascii() and part.isidentifier() for part in name.split("/"))
        assert all(field.isascii() and field.isidentifier() for field, _ in fields)


def test_idl_definitions_of_rosbag2_go_through_the_same_checks():
    idl = """
module pkg { module msg {
  struct Inner { int32 x; };
  struct Outer { pkg::msg::Inner inner; sequence<double> values; string name; octet b; uint8 fixed[3]; };
}; };
"""
    fields = dict(read_definition("pkg/Outer", idl, "idl").fields["pkg/msg/Outer"])
    assert list(fields) == ["inner", "values", "name", "b", "fixed"]
    assert fields["values"] == (Nodetype.SEQUENCE, ((Nodetype.BASE, ("float64", 0)), 0))
    for broken in ("module a {", "module pkg { module msg { struct Outer { wstring w; }; }; };", "struct", "\x00"):
        with pytest.raises(DefinitionError):
            read_definition("pkg/Outer", broken, "idl")


def test_a_tree_from_elsewhere_is_checked_like_text():
    for fields in (
        [("x'", (Nodetype.BASE, ("int32", 0)))],
        [("x", (Nodetype.BASE, ("int32'", 0)))],
        [("x", (Nodetype.NAME, "a/msg/B'"))],
        [("x", (Nodetype.ARRAY, ((Nodetype.BASE, ("int32", 0)), -1)))],
    ):
        with pytest.raises(DefinitionError):
            check_types("a/msg/A", {"a/msg/A": fields, "a/msg/B'": []})


def test_known_types_follow_their_distribution():
    assert "seq" in dict(decoder_for_known(Wire.ROS1, "std_msgs/Header").fields["std_msgs/msg/Header"])
    assert "seq" not in dict(decoder_for_known(Wire.CDR, "std_msgs/Header", "humble").fields["std_msgs/msg/Header"])
    assert decoder_for_known(Wire.CDR, "my_pkg/Unheard") is None
    assert decoder_for_known(Wire.CDR, "std_msgs/Header", "a_distribution_to_come") is not None


IDL_OF_ROSIDL = """
// generated from rosidl_adapter/resource/msg.idl.em
#include "geometry_msgs/msg/Point.idl"

module pkg {
  module msg {
    typedef double double__36[36];
    module Outer_Constants {
      @verbatim (language="comment", text="a ) in a comment" "\\n" "and \\" more")
      const octet LIMIT = 7;
      const string TEXT = "const long x = 1;";
    };
    @verbatim (language="comment", text=
      "what it is for")
    struct Outer {
      @vendor::unit (value="m")
      geometry_msgs::msg::Point point;
      double__36 covariance;
      sequence<uint8> data;
      sequence<string<5>, Outer_Constants::LIMIT> names;
      unsigned long long big; long long signed_big; unsigned short us; long l;
      @default (value=3)
      octet a, b[2];
      Inner inner;
      ::pkg::msg::Inner absolute;
      boolean flag;
    };
  };
};
"""


def test_idl_as_rosidl_generates_it():
    base, name, array, sequence = Nodetype.BASE, Nodetype.NAME, Nodetype.ARRAY, Nodetype.SEQUENCE
    point = "module geometry_msgs { module msg { struct Point { double x; }; }; };"
    inner = "module pkg { module msg { struct Inner { /* a comment */ float y; }; }; };"
    text = (
        f"{SEPARATOR}\nIDL: pkg/msg/Outer\n{IDL_OF_ROSIDL}\n"
        f"{SEPARATOR}\nIDL: geometry_msgs/msg/Point\n{point}\n"
        f"{SEPARATOR}\nIDL: pkg/msg/Inner\n{inner}\n"
    )
    read = read_definition("pkg/msg/Outer", text, "idl")
    # In the log it is MSG, like any other.
    assert read_definition("pkg/msg/Outer", read.text).fields == read.fields
    assert dict(read.fields["pkg/msg/Outer"]) == {
        "point": (name, "geometry_msgs/msg/Point"),
        "covariance": (array, ((base, ("float64", 0)), 36)),
        "data": (sequence, ((base, ("uint8", 0)), 0)),
        "names": (sequence, ((base, ("string", 5)), 7)),
        "big": (base, ("uint64", 0)),
        "signed_big": (base, ("int64", 0)),
        "us": (base, ("uint16", 0)),
        "l": (base, ("int32", 0)),
        "a": (base, ("byte", 0)),
        "b": (array, ((base, ("byte", 0)), 2)),
        "inner": (name, "pkg/msg/Inner"),
        "absolute": (name, "pkg/msg/Inner"),
        "flag": (base, ("bool", 0)),
    }


@pytest.mark.parametrize(
    "text",
    [
        "module a {" * 100_00,
        "/* " * 50_000,
        '"' * 100_001,
        "module pkg { module msg { struct T { " + "sequence<" * 5000,
        "module pkg { module msg { const long A = " + "(" * 5000,
        "module pkg { module msg { typedef T T; struct T { T t; }; }; };",
        "module pkg { module msg { struct T { enum x; }; }; };",
        "module pkg { module msg { union T switch (long) { case 1: long x; }; }; };",
        "module pkg { module msg { struct T { long x[2][2]; }; }; };",
        "module pkg { module msg { struct T { long x[N]; }; }; };",
        "module pkg { module msg { struct T : U { long x; }; }; };",
        "module pkg { module msg { struct T { unsigned float x; }; }; };",
        "module pkg { module msg { struct T { sequence<sequence<long>> x; }; }; };",
        "module pkg { module msg { typedef long L[2]; struct T { L x[2]; }; }; };",
        "module pkg { module msg { struct T { long double x; }; }; };",
        "module pkg { module msg { struct T { long x } }; };",
        "module pkg { module msg { struct T { long x; }; struct T { long y; }; }; };",
        "@" * 1000,
        "@a(" * 10_000,
        "é",
        "module pkg { module msg { struct T { long x[1 << 99999999999999]; }; }; };",
        "module pkg { module msg { struct T { long x[" + "(" * 200 + "1" + ")" * 200 + "]; }; }; };",
        "module pkg { module msg { struct T { long x[" + "9" * 5000 + "]; }; }; };",
        "module pkg { module msg { struct T { " + "a::" * 5000 + "b x; }; }; };",
        "module pkg { module msg { " + "".join(f"typedef T{n + 1} T{n};" for n in range(2000)) + "struct T { T0 x; };",
        "module pkg { module msg { struct T { " + "sequence<long, 4> x; " * 3000 + "}; }; };",
        "module pkg { module msg { " + "const long A = 1;" * 2000 + "struct T { " + "long x[A];" * 1000 + "}; }; };",
        "struct T { long x; }; " * 3000,
        "const",
        "const long",
        "const ;",
        "const long A = ;",
        "module a { struct b { string<<5>> x; }; };",
        "#" * 200_000 + "\n'",
        "// " * 60_000 + "\n@",
    ],
    ids=range(35),
)
@pytest.mark.timeout(120)
def test_hostile_idl_is_refused_quickly(text):
    started = time.process_time()
    with pytest.raises(DefinitionError):
        read_definition("pkg/T", text, "idl")
    assert time.process_time() - started < 30


TOKENS = ["module", "struct", "typedef", "const", "sequence", "string", "long", "double", "unsigned", "enum", "union",
          "a", "b", "T", "::", "<", ">", "{", "}", "[", "]", ";", ",", "=", "1", "4096", "@", "(", ")", "<<", '"x"',
          "+"]  # fmt: skip


@given(st.lists(st.sampled_from(TOKENS), max_size=60).map(" ".join), st.booleans())
@pytest.mark.timeout(120)
def test_any_arrangement_of_idl_is_a_definition_or_an_error(text, wrapped):
    if wrapped:
        text = f"module pkg {{ module msg {{ struct T {{ {text} }}; }}; }};"
    with contextlib.suppress(DefinitionError):
        read_definition("pkg/T", text, "idl")


@pytest.mark.timeout(120)
def test_many_bounds_in_idl_are_read_quickly():
    text = f"module pkg {{ module msg {{ struct T {{ {' '.join(f'string<5> x{n};' for n in range(900))} }}; }}; }};"
    started = time.process_time()
    assert len(read_definition("pkg/T", text, "idl").fields["pkg/msg/T"]) == 900
    assert time.process_time() - started < 30


@pytest.mark.timeout(120)
def test_constants_in_idl_are_not_computed():
    # Each of these makes a parser that evaluates or backtracks run for hours.
    for value in ("1 << 99999999999999", "(" * 200 + "1" + ")" * 200, "9" * 100_000):
        text = f"module pkg {{ module msg {{ const long A = {value}; struct T {{ long x; }}; }}; }};"
        assert read_definition("pkg/T", text, "idl").smallest["pkg/msg/T"] == 4


def in_a_struct(members: str) -> str:
    return f"module pkg {{ module msg {{ struct T {{ {members} }}; }}; }};"


@pytest.mark.timeout(120)
@pytest.mark.parametrize("blank", ["\n", " \n", "# a comment\n", "\r\n", "\t#\n"])
def test_blank_lines_and_comments_cost_nothing(blank):
    """rosbags' own time grows with the square of their number: 200,000 newlines would take a minute."""
    started = time.process_time()
    lines = MAX_TEXT // len(blank) - 20
    read = read_definition("a/A", f"int32 x\n{blank * lines}int32 y\n")
    assert [name for name, _ in read.fields["a/msg/A"]] == ["x", "y"] and read.text == "int32 x\nint32 y\n"
    assert time.process_time() - started < 30


@pytest.mark.timeout(120)
@pytest.mark.parametrize(("members", "why"), [
    ("sequence<" * 30 + "long" + ">" * 30 + " x;", "nested sequences"),
    ("sequence<sequence<long>> x;", "nested sequences"), ("sequence < sequence <long> > x;", "nested sequences"),
    ("sequence<string<5>> x;", None), ("sequence<pkg::msg::T<long<5>>> x;", "nested sequences"),
    ("long x[" + "(" * 40 + "1" + ")" * 40 + "];", "expressions"), ("long x[1 << 99999999999];", "expressions"),
    ("long x[2 + 2];", "expressions"), ("long x[-1];", "expressions"),
    ("a::" * 8 + "b x;", "deeper scopes"), ("struct U {" * 8 + "long x;" + "};" * 8, "deeper scopes"),
    ("".join(f"long x{n};" for n in range(2_000)), "declarations"),
    ("long " + ",".join(f"x{n}" for n in range(2_000)) + ";", "declarations"),
    ("".join(f"long x{n};" for n in range(1_000)), None),
])  # fmt: skip
def test_idl_is_bounded_before_it_is_parsed(members, why):
    started = time.process_time()
    if why is None:
        assert read_definition("pkg/T", in_a_struct(members), "idl").fields["pkg/msg/T"]
    else:
        with pytest.raises(DefinitionError, match=why):
            read_definition("pkg/T", in_a_struct(members), "idl")
    assert time.process_time() - started < 30


@pytest.mark.timeout(120)
def test_a_definition_is_bounded_before_it_is_parsed():
    for text, why in (
        ("int32[] x [" + "1," * MAX_KEPT, "without its comments"), ("int32[" + "9" * 5_000 + "] x", "cannot be read"),
        ("@key\n" * (MAX_KEPT // 6 - 10), None), ("a_" * (MAX_KEPT // 2 - 100) + "! x", "cannot be read"),
    ):  # fmt: skip
        started = time.process_time()
        if why is None:
            assert read_definition("a/A", text).fields["a/msg/A"] == []
        else:
            with pytest.raises(DefinitionError, match=why):
                read_definition("a/A", text)
        assert time.process_time() - started < 30


def test_constants_count_for_the_sum_as_they_are_written():
    """One a line, constants first (wiki.ros.org/ROS/Technical Overview); genpy is asked in ros1/test_publication.py."""
    text = 'uint8 A=0x01\nstring S= "a # b" \nfloat32 F=1e-3\nuint8 lower_case=1\nint32 x\n'
    expected = 'uint8 A=0x01\nstring S="a # b"\nfloat32 F=1e-3\nuint8 lower_case=1\nint32 x'
    assert read_definition("a/B", text).md5 == hashlib.md5(expected.encode()).hexdigest()
