"""The live page: a process of its own that reads a deployment over Zenoh and shows it in browsers."""
