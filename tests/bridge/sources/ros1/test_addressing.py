"""ROS's environment variables and URIs."""

from __future__ import annotations

import socket

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rosbridge_eth.config import Address
from rosbridge_eth.errors import SourceError
from rosbridge_eth.robot.sources.ros1.api import (
    ProtocolError,
    bind_host,
    master_address,
    node_name,
    offers,
    own_host,
    read_uri,
)

MASTER = Address("127.0.0.1", 11311)


@pytest.mark.parametrize(
    ("configured", "environment", "expected"),
    [
        (None, {}, ("localhost", 11311)),
        (None, {"ROS_MASTER_URI": ""}, ("localhost", 11311)),
        (None, {"ROS_MASTER_URI": "http://robot:11399/"}, ("robot", 11399)),
        ("http://192.0.2.7:5", {"ROS_MASTER_URI": "http://robot:11399/"}, ("192.0.2.7", 5)),
        ("http://192.0.2.7", {}, ("192.0.2.7", 11311)),
        ("http://[2001:db8::7]:5/", {}, ("2001:db8::7", 5)),
    ],
)
def test_the_master_is_where_the_configuration_or_the_environment_says(configured, environment, expected):
    assert master_address(configured, environment) == expected


def test_a_wrong_master_is_told_with_the_place_where_it_is_written():
    with pytest.raises(SourceError, match="the environment variable ROS_MASTER_URI is wrong"):
        master_address(None, {"ROS_MASTER_URI": "robot:11311"})
    with pytest.raises(SourceError, match=r"`master` of \[source\] is wrong"):
        master_address("http://robot:99999", {})


@pytest.mark.parametrize(
    ("configured", "environment", "expected"),
    [
        ("robot", {"ROS_HOSTNAME": "a", "ROS_IP": "192.0.2.1"}, "robot"),
        (None, {"ROS_HOSTNAME": "a", "ROS_IP": "192.0.2.1"}, "a"),
        (None, {"ROS_IP": "192.0.2.1"}, "192.0.2.1"),
        (None, {}, "127.0.0.1"),  # the address towards a master on this machine
    ],
)
def test_ros_hostname_precedes_ros_ip(configured, environment, expected):
    assert own_host(configured, MASTER, environment) == expected


def test_a_master_that_cannot_be_found_leaves_our_own_address_open():
    assert own_host(None, Address("no-such-host.invalid", 11311), {}) is None


def test_a_name_that_can_be_none_is_one_that_does_not_resolve():
    assert own_host(None, Address("robot..lan", 11311), {}) is None
    assert own_host(None, Address("r" * 64, 11311), {}) is None


def test_of_a_masters_addresses_one_without_a_route_is_passed_over(monkeypatch):
    hosts = ["255.255.255.255", "127.0.0.1"]  # the first is for those who ask to broadcast

    def resolved(_host, port, **_):
        return [(socket.AF_INET, socket.SOCK_DGRAM, 0, "", (host, port)) for host in hosts]

    monkeypatch.setattr(socket, "getaddrinfo", resolved)
    assert own_host(None, Address("master", 11311), {}) == "127.0.0.1"
    hosts.pop()
    assert own_host(None, Address("master", 11311), {}) is None


def test_we_listen_where_we_say():
    assert bind_host("localhost") == bind_host("127.0.0.1") == "127.0.0.1"
    assert bind_host("robot") == bind_host("192.0.2.1") == "0.0.0.0"
    assert bind_host("2001:db8::1") == "::"
    assert read_uri(f"http://{Address('2001:db8::1', 5)}/") == ("2001:db8::1", 5)


@pytest.mark.parametrize(
    "uri",
    ["", "robot", "http://", "http://:5", "http://robot", "ftp://robot:5", "http://robot:0", "http://robot:65536",
     "http://robot:x", "http://a b:5", "http://[::1:5", "http://" + "a" * 600 + ":5", "rosrpc://robot:5"],
)  # fmt: skip
def test_what_is_no_uri_of_a_node_is_refused(uri):
    with pytest.raises(ProtocolError):
        read_uri(uri)


@given(st.one_of(st.text(max_size=60), st.text(max_size=40).map("http://{}:5".format)))
def test_any_text_is_an_endpoint_or_refused(text):
    try:
        endpoint = read_uri(text)
    except ProtocolError:
        return
    assert 0 < endpoint.port < 65536


def test_names():
    assert node_name("/a/b") == node_name("a/b") == "/a/b"
    names = ["", "/", "a", "/a b", "/a\n", "/" + "a" * 300, "/ä", own := node_name(None)]
    assert [offer.topic for offer in offers({name: ["/n"] for name in names}, {})] == [own]
