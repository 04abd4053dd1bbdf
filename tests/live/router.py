"""A Zenoh router for tests: `python tests/live/router.py ENDPOINT`. With it the tests need no zenohd."""

import sys
import threading

from neurove_service.transport import open_transport


def main() -> None:
    with open_transport("router", listen=(sys.argv[1],)):
        threading.Event().wait()


if __name__ == "__main__":
    main()
