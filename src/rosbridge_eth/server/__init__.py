"""The server's side: takes chunks from robots and writes them to the chain."""
