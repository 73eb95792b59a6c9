"""The blockchain end: takes records from robots, keeps them until they are on the chain, answers where they are."""
