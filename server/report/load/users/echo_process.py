"""Bare zenoh process that answers any query below `echo/` with a fixed number of bytes.

Arguments: the endpoint to listen on, and the bytes of a reply. It prints `ready`, and ends at the
end of its input.
"""

import json
import sys

import zenoh


def main() -> None:
    """Answer until standard input ends."""
    config = zenoh.Config()
    config.insert_json5("listen/endpoints", json.dumps([sys.argv[1]]))
    config.insert_json5("scouting/multicast/enabled", "false")
    reply = bytes(int(sys.argv[2]))

    def echo(query: zenoh.Query) -> None:
        with query:
            query.reply(query.key_expr, reply)

    with zenoh.open(config) as session, session.declare_queryable("echo/*", echo):
        print("ready", flush=True)
        sys.stdin.read()


if __name__ == "__main__":
    main()
