"""The fast path: a network's inference in compiled code. README.md lists each form with its reference and its test."""
