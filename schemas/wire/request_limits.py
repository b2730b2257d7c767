"""Limits of one request: how many poses, rays, points, objects and bytes it may have.

They bound what one request can cost a server. A server may lower `MAX_POSES` and
`MAX_AVATAR_POINTS` (`ServerConfig`); how many requests and bytes may be in flight together is
configured there, too.
"""

# Poses, rays, points or motions of one request, or poses of one path: 12.8 MB, twice that for a
# sweep. A server of wire version 1 would drop larger messages unanswered, so neither this nor the
# number of points may be raised.
MAX_POSES = 100_000
# Points of an avatar: 24 MB.
MAX_AVATAR_POINTS = 1_000_000
# Objects of one request. All pairs of them fit into one answer: 19 MB.
MAX_OBJECTS = 2048
# Pairs listed for a pose. With this many, one pose's answer is 7 MB.
MAX_CONTACTS = 10_000
# Characters of the name of an avatar, a scene, a client or a radius model.
MAX_NAME_LENGTH = 64
# Duration of a frame [s].
MAX_FRAME_SECONDS = 10.0

# Any encoded message [bytes]. A peer of wire version 1 would drop larger messages unread, so this
# may not be raised.
MAX_MESSAGE_BYTES = 32 << 20
# A motion command [bytes]: 2,048 objects take less as MessagePack. A larger one is neither decoded
# nor logged.
MAX_COMMAND_BYTES = 512 << 10
# Size up to which a request is always accepted from a client without other requests in flight
# [bytes].
FIRST_REQUEST_BYTES = 1 << 16
