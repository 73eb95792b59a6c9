"""From the name of a ROS topic to a verified record read back from an Ethereum chain."""

import sys

if sys.version_info < (3, 11):  # noqa: UP036 - the library smcrypto, in the same distribution, runs on 3.10
    raise ImportError("rosbridge_eth, the bridge, needs Python 3.11 or later; smcrypto, the library, does with 3.10")
