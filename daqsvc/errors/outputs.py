"""Outputs: MQTT, Sparkplug, metrics and the page."""

from daqsvc.errors.code import Code

_PAGE = "mqtt.md"

CREDENTIAL_FILE = Code(
    "O01",
    "The file of a credential cannot be used",
    "It is no regular file, or its first line is longer than MQTT can carry.",
    "Write the password, and nothing else, into the first line of a regular file.",
    _PAGE,
    example='machine.toml:285: mqtt.password_file = "": is no regular file, and reading it might never end. '
    "Remedy: name a file with that content",
)
CREDENTIAL_OPEN = Code(
    "O02",
    "Everybody on this machine can read the credential",
    "The rights of the file let every user read it.",
    "Remove that right: chmod o-rwx FILE. Then replace what is in it.",
    _PAGE,
    example='machine.toml:142: mqtt.password_file = "/etc/daqsvc/mqtt-password": can be read by every user '
    "of this machine. Remedy: chmod o-rwx /etc/daqsvc/mqtt-password, and replace what is in it",
)
UNENCRYPTED = Code(
    "O03",
    "It would go unencrypted",
    "mqtt:// has no encryption and does not verify the broker. Others on the network can read or forge it.",
    "Write mqtts:// in the URL. insecure = true accepts the risk where a network is closed, or for a broker "
    "on this box.",
    _PAGE,
    example='machine.toml:140: mqtt.url = "mqtt://broker.example:8883": would go over the network '
    "unencrypted, and to whoever answers. Remedy: write mqtts://, or insecure = true if you accept "
    "that",
)
OPEN_TO_NETWORK = Code(
    "O04",
    "Others on the network can reach it",
    "The address to listen at is not that of this box alone, and there is no TLS or no sign-in.",
    "Listen at 127.0.0.1, or set up what the message names.",
    "page.md",
    example='machine.toml:151: page.listen = "192.0.2.1:8420": lets others than this box reach the page, '
    "which needs TLS and accounts then. Remedy: write certificate_file, private_key_file and "
    'accounts_file; or user_header and proxies, behind a reverse proxy; or listen = "127.0.0.1:8420"',
)
HOST_NAMES = Code(
    "O05",
    "It is not known by which names the page is opened",
    "The page answers only requests to names that it knows. An address that means all of the box names none.",
    "Write host_names with each name or address by which browsers open the page.",
    "page.md",
    example='machine.toml:151: page.listen = "0.0.0.0:8420": is every address of the box, and it is not '
    'known by which names the page is opened. Remedy: write host_names = ["..."] with each, also if '
    "it is an address of the box",
)
ONE_DEVICE = Code(
    "O06",
    "One device of Sparkplug is named for several machines",
    "Each machine is a device of the edge node.",
    "Remove device: the name of each machine is its device id.",
    "sparkplug.md",
    example='two.toml:140: mqtt.sparkplug.device = "fan": "fan" names one device, and each of several '
    "machines is one. Remedy: remove it: the name of each machine is its device id",
)
SAME_CLIENT_ID = Code(
    "O07",
    "Two connections have one client id",
    "A broker ends a connection when another one comes with the same client id.",
    "Remove client_id, or write another one.",
    "sparkplug.md",
    example='machine.toml:146: mqtt.sparkplug.client_id = "daqsvc-lab:edge-1": is "daqsvc-lab:edge-1" like '
    "that of [mqtt]: a broker ends one connection for the other. Remedy: remove it, or write another",
)
OTHER_ENCRYPTION = Code(
    "O08",
    "The servers have other encryption than the broker",
    "All servers of Sparkplug get the credentials of [mqtt]. An unencrypted one would give them away.",
    "Write mqtts:// in all URLs, or mqtt:// in all.",
    "sparkplug.md",
    example='machine.toml:146: mqtt.sparkplug.servers[0] = "mqtt://other.example": has other encryption than '
    "mqtt.url, whose credentials it would get. Remedy: write mqtts:// in both",
)
BROKER_AWAY = Code(
    "O09",
    "The broker cannot be reached",
    "It does not run, its name or address is wrong, or the network is interrupted. Alarms wait on disk.",
    "Look at mqtt.url, the network and the broker. All that waits is sent when it is back.",
    "mqtt.md",
    "MQTT broker 10.0.0.1:8883 is away: nothing listens there; trying again until it is back",
)
BROKER_TLS = Code(
    "O10",
    "TLS with the broker fails",
    "Its certificate has expired, is for another host, or is signed by nobody in ca_file; or one side "
    "lacks a "
    "certificate or a version of TLS.",
    "Correct ca_file and the host in mqtt.url, or renew the certificate that the message names.",
    "mqtt.md",
    "MQTT broker 10.0.0.1:8883 is away: its certificate is not signed by an authority in "
    "ca_file: self-signed "
    "certificate",
)
BROKER_REFUSES = Code(
    "O11",
    "The broker refuses the connection",
    "User or password are wrong, this client is not allowed, or the broker has a limit that is reached.",
    "Correct username and password_file, or allow this client at the broker.",
    "mqtt.md",
    "MQTT broker 10.0.0.1:8883 is away: user name or password are wrong",
)
TOPIC_REFUSED = Code(
    "O12",
    "The broker does not allow a topic",
    "This client may connect, but not write or read the topic, or the message is too large for the broker.",
    "Allow the topic to this client in the access list of the broker, or raise its limit of size.",
    "mqtt.md",
    "MQTT broker 10.0.0.1:8883 refuses an alarm message on daqsvc/lab/edge-1/pump/alarms/housing: the "
    "broker refuses messages: Not authorized; it is kept on disk and tried again now and then, and all "
    "others go on",
)
CLIENT_ID_TAKEN = Code(
    "O13",
    "Another client has the same client id",
    "A broker ends a connection when another client comes with the same id. Both end each other in turn.",
    "Give each box its own box name, or mqtt.client_id. Watch several machines of one box with one service: "
    "daqsvc run a.toml b.toml.",
    "several-machines.md",
    "MQTT broker 10.0.0.1:8883: this connection was ended by another client with client_id "
    "'daqsvc-lab:edge-1'; give each box its own box name or mqtt.client_id, and watch several machines of "
    "one box with one service: daqsvc run a.toml b.toml",
)
CERTIFICATE_UNKNOWN = Code(
    "O14",
    "The end of a certificate is not known",
    "The certificate cannot be read as one, so that no alarm can be raised before it ends.",
    "Look at the file that the message names, and note when the certificate ends.",
    "mqtt.md",
    "no alarm will warn before the certificates in /etc/daqsvc/ca.pem end: it holds no certificate",
)
MESSAGE_DROPPED = Code(
    "O15",
    "Messages are dropped",
    "Telemetry is dropped where there is no room, or the broker does not take it. Alarms are not.",
    "Check the disk and the broker. Every dropped message is counted: daqsvc status.",
    "outbox.md",
    "telemetry in /var/lib/daqsvc/telemetry.bin is dropped: the disk is nearly full",
)
OUTPUT_STATE = Code(
    "O16",
    "What an output remembers cannot be kept",
    "A small file of the output in the store cannot be read or written. After a restart it may tell things "
    "twice, or leave old ones standing.",
    "Check the disk and the rights of the store.",
    "outputs.md",
    "Sparkplug memory /var/lib/daqsvc/sparkplug.json cannot be written: No space left on device",
)
OUTPUT_FAILED = Code(
    "O17",
    "An output has failed",
    "A mistake in the output, or in the library below it. The machine is watched, and other outputs go on.",
    "Do what the message asks for. If it happens again, report it with the lines of the log before.",
    "outputs.md",
    "metrics: a request has failed: ConnectionResetError(); the others are answered",
)
HISTORY_DAMAGED = Code(
    "O18",
    "The history is damaged",
    "The file of the history cannot be read any more. It is set aside, and a new one is begun.",
    "Check the disk. What was set aside may be read with the tools of SQLite.",
    "history.md",
    "the history /var/lib/daqsvc/history.sqlite is damaged (file is not a database): it is now "
    "history.sqlite.corrupt-1, and a new one is begun",
)
PAGE_ENDED = Code(
    "O19",
    "The page has ended",
    "The process of the page could not begin, or was ended. It is started again.",
    "Look at the line of the log before. A port that is taken needs another page.listen.",
    "page.md",
    "the page at 127.0.0.1:8420 has ended, and is started again: exit code 1",
)
HOST_MISSING = Code(
    "O20",
    "The primary host of Sparkplug is not there",
    "The host that the machine file names is offline, so that nothing is sent to it. Alarms wait.",
    "Start the host application, or correct primary_host.",
    "sparkplug.md",
    "Sparkplug sends nothing yet: primary host scada1 has sent no state that can be read on "
    "spBv1.0/STATE/scada1 or STATE/scada1",
)
COMMAND_NOT_OBEYED = Code(
    "O21",
    "A command that came over an output is refused",
    "It is no command of daqsvc, has no time, is too old, has come before, or the machine file does not "
    "allow it over this output.",
    "Do what the message asks for. daqsvc alarms shows the state of each alarm.",
    "mqtt.md",
    "spBv1.0/plant/DCMD/edge-1/pump is refused: it does not state when it was sent",
)
NOT_SHOWN = Code(
    "O22",
    "A viewer does not get what it shows",
    "The broker does not let this client send or listen to what a page or a dashboard asks for. Or what "
    "comes there is no message of daqsvc, or there are as many viewers as max_viewers of [mqtt.live] allows.",
    "Allow the topics to this client in the access list of the broker, or close another viewer.",
    "page.md",
    "the MQTT broker does not let this client subscribe to daqsvc/lab/live: no live data is sent over it",
)
CERTIFICATE_ENDS = Code(
    "O23",
    "A certificate ends soon, or has ended",
    "With a certificate that has ended, TLS with the broker fails.",
    "Renew the certificate. The service reads new files by itself.",
    "mqtt.md",
    "alarm certificate/broker raised: certificate/broker alert: certificate broker ends at "
    "2026-12-07T09:00:00.000000Z, in less than 14 days: renew it",
)
DATABASE_AWAY = Code(
    "O24",
    "PostgreSQL does not take the messages",
    "config/postgresql/ingest.py does not reach it, it is read-only or full, or lacks a table or a right.",
    "Do what the message asks for. Nothing is lost: the broker keeps the messages until PostgreSQL takes "
    "them.",
    "postgresql.md",
    "PostgreSQL is away, and nothing is acknowledged: the database system is shutting down",
)
PAGE_SAYS = Code(
    "O25",
    "The process of the page reports something",
    "The page runs in its own process. What this prints is in the log of the service, behind 'page:'.",
    "Do what the message asks for. The service and its alarms do not depend on the page.",
    "page.md",
    "page: WARNING:  Invalid HTTP request received.",
)
