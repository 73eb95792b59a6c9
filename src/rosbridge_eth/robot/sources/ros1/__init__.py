"""A live ROS 1 graph, read with no ROS installed: XML-RPC and TCPROS (wiki.ros.org/ROS/Technical Overview).

    addressing  environment variables, URIs, names
    api         calls of the master's and the publishers' APIs, and our own: bounded XML-RPC over HTTP
    tcpros      a publisher's connection: header, type and decoder, messages
    publisher   one thread for each publisher: connect, read, try again
    source      the Source: what is registered, and whom we are connected to

ROS 1 has no authentication: whoever reaches the network can publish. What is promised is that no publisher, master or
caller of our API can make the bridge crash, wait, or use more memory than was set.
"""
