"""`sample_bag` by its former place; import it from rosbridge_eth.sources."""

from rosbridge_eth.sources.bag import sample_bag as sample_bag
