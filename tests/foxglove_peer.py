#!/usr/bin/env python3
"""A client of the Foxglove WebSocket protocol for tests/e2e/live_page.rs: websockets (PyPI) for the connection, rosbags for the
messages. It subscribes to all channels, reads until it has a message of each, and prints them as JSON by topic.

Usage: foxglove_peer.py ADDRESS SUBPROTOCOL [ORIGIN]
"""

import json
import struct
import sys

from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from websockets.sync.client import connect


def main() -> None:
    address, subprotocol, *origin = sys.argv[1:]
    with connect(address, subprotocols=[subprotocol], origin=origin[0] if origin else None, max_size=None) as socket:
        assert socket.subprotocol == subprotocol
        info, advertised = json.loads(socket.recv()), json.loads(socket.recv())
        assert (info["op"], advertised["op"]) == ("serverInfo", "advertise")
        while not advertised["channels"]:
            advertised = json.loads(socket.recv())
        store = get_typestore(Stores.EMPTY)
        channels = {}
        for channel in advertised["channels"]:
            assert (channel["encoding"], channel["schemaEncoding"]) == ("cdr", "ros2msg")
            types = get_types_from_msg(channel["schema"], channel["schemaName"])
            store.register({name: of for name, of in types.items() if name not in store.fielddefs})
            channels[channel["id"] + 100] = channel
        # Mistakes are told, and the connection goes on.
        socket.send("no JSON")
        socket.send(json.dumps({"op": "subscribe", "subscriptions": [{"id": 1, "channelId": 99999}]}))
        socket.send(json.dumps({"op": "getParameters", "parameterNames": []}))
        for _ in range(2):
            status = json.loads(socket.recv())
            assert (status["op"], status["level"]) == ("status", 2), status
        wanted = [{"id": id, "channelId": channel["id"]} for id, channel in channels.items()]
        socket.send(json.dumps({"op": "subscribe", "subscriptions": wanted}))
        found = {}
        while len(found) < len(channels):
            message = socket.recv()
            assert isinstance(message, bytes), message
            kind, id, _nanos = struct.unpack_from("<BIQ", message)
            assert kind == 1
            channel = channels[id]
            decoded = store.deserialize_cdr(message[13:], channel["schemaName"])
            found[channel["topic"]] = {"schema": channel["schemaName"], "fields": plain(decoded)}
        # Nothing comes of a channel that is not wanted any more.
        socket.send(json.dumps({"op": "unsubscribe", "subscriptionIds": list(channels)}))
        quiet = False
        while not quiet:
            try:
                socket.recv(timeout=1)
            except TimeoutError:
                quiet = True
    print(json.dumps(found))


def plain(value):
    """A message as JSON has it."""
    if hasattr(value, "__dataclass_fields__"):
        return {name: plain(getattr(value, name)) for name in value.__dataclass_fields__ if name != "__msgtype__"}
    if hasattr(value, "tolist"):
        return value.tolist()
    return [plain(item) for item in value] if isinstance(value, list) else value


main()
