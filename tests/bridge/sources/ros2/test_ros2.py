"""The ros2 source against genuine nodes: types, qualities of service, nodes that come, go, die and lie."""

from __future__ import annotations

import itertools
import json
import shutil
import sys
from pathlib import Path

import pytest
from rosbags.typesys import Stores, get_typestore
from ros2_graph import Graph, free_domain, graph, ros2_python
