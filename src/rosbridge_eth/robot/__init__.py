"""The robot's side: from its topics to the server."""
