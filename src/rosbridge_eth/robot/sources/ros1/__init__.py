"""A live ROS 1 graph, read with no ROS installed: XML-RPC and TCPROS (wiki.ros.org/ROS/Technical Overview).

    api         addresses and names, calls of the master's and the publishers' APIs, and our own API
    tcpros      a publisher's connection: header, type and decoder, messages
    source      the Source: what is registered, and one thread for each publisher that it is connected to

ROS 1 has no authentication: whoever reaches the network can publish. What a peer sends ends in a message, or in its own
connection being closed; every step of a call has a timeout, and messages are bounded.
"""
