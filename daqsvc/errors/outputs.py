"""Outputs: MQTT, Sparkplug, metrics and the page."""

from daqsvc.errors.code import Code

_PAGE = "mqtt.md"

CREDENTIAL_FILE = Code(
    "O01",
    "The file of a credential cannot be used",
    "It is no regular file, or its first line is longer than MQTT can carry.",
    "Write the password, and nothing else, into the first line of a regular file.",
    _PAGE,
)
CREDENTIAL_OPEN = Code(
    "O02",
    "Everybody on this machine can read the credential",
    "The rights of the file let every user read it.",
    "Take the rights away: chmod o-rwx FILE. Then replace what is in it.",
    _PAGE,
)
UNENCRYPTED = Code(
    "O03",
    "It would go over the network unencrypted",
    "mqtt:// has no encryption and does not verify the broker. Others on the network can read or forge it.",
    "Write mqtts:// in the URL. insecure = true accepts the risk where a network is closed.",
    _PAGE,
)
OPEN_TO_NETWORK = Code(
    "O04",
    "Others on the network can reach it",
    "The address to listen at is not that of this box alone, and there is no TLS or no sign-in.",
    "Listen at 127.0.0.1, or set up what the message names.",
    "page.md",
)
HOST_NAMES = Code(
    "O05",
    "It is not known by which names the page is opened",
    "The page answers only requests to names that it knows. An address that stands for all of the box "
    "names none.",
    "Write host_names with each name or address by which browsers open the page.",
    "page.md",
)
ONE_DEVICE = Code(
    "O06",
    "One device of Sparkplug stands for several machines",
    "Each machine is a device of the edge node.",
    "Remove device: the name of each machine is its device id.",
    "sparkplug.md",
)
SAME_CLIENT_ID = Code(
    "O07",
    "Two connections have one client id",
    "A broker ends a connection when another one comes with the same client id.",
    "Remove client_id, or write another one.",
    "sparkplug.md",
)
OTHER_ENCRYPTION = Code(
    "O08",
    "The servers have other encryption than the broker",
    "All servers of Sparkplug get the credentials of [mqtt]. An unencrypted one would give them away.",
    "Write mqtts:// in all URLs, or mqtt:// in all.",
    "sparkplug.md",
)
