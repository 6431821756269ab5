-- Alarm events and telemetry of daqsvc. Run it as the owner of the database, as often as you like.
CREATE SCHEMA IF NOT EXISTS daqsvc;

-- Every event of every alarm, once: daqsvc never uses an id twice.
CREATE TABLE IF NOT EXISTS daqsvc.alarm_events (
    id          text PRIMARY KEY,
    site        text        NOT NULL,
    box         text        NOT NULL,
    machine     text        NOT NULL,
    alarm       text        NOT NULL,
    sequence    bigint      NOT NULL,
    occurrence  text,
    at          timestamptz NOT NULL,
    kind        text        NOT NULL,
    state       text        NOT NULL,
    level       text        NOT NULL,
    message     text        NOT NULL,
    event       jsonb       NOT NULL,
    ingested_at timestamptz NOT NULL DEFAULT now()
);
CREATE INDEX IF NOT EXISTS alarm_events_latest
    ON daqsvc.alarm_events (site, box, machine, alarm, sequence DESC);
CREATE INDEX IF NOT EXISTS alarm_events_at ON daqsvc.alarm_events (at);

-- What the detectors stated. The key leads with its time so that TimescaleDB can cut the table by it.
CREATE TABLE IF NOT EXISTS daqsvc.diagnoses (
    at           timestamptz NOT NULL,
    site         text        NOT NULL,
    box          text        NOT NULL,
    machine      text        NOT NULL,
    detector     text        NOT NULL,
    monotonic_ns bigint      NOT NULL,
    decision     text        NOT NULL,
    severity     text        NOT NULL,
    quality      text        NOT NULL,
    statistics   jsonb       NOT NULL,
    diagnosis    jsonb       NOT NULL,
    PRIMARY KEY (at, site, box, machine, detector, monotonic_ns)
);

-- Messages that are no events or diagnoses of a version that this schema knows.
CREATE TABLE IF NOT EXISTS daqsvc.rejected (
    at      timestamptz NOT NULL DEFAULT now(),
    topic   text  NOT NULL,
    payload bytea NOT NULL,
    reason  text  NOT NULL
);
-- Each of them once, however many ingesters get it. The sums are short enough for an index.
DELETE FROM daqsvc.rejected AS later USING daqsvc.rejected AS first
    WHERE (later.topic, later.payload) = (first.topic, first.payload) AND later.ctid > first.ctid
    AND to_regclass('daqsvc.rejected_once') IS NULL;
CREATE UNIQUE INDEX IF NOT EXISTS rejected_once ON daqsvc.rejected (md5(topic), sha256(payload));

-- The state of each alarm.
CREATE OR REPLACE VIEW daqsvc.alarms_now AS
SELECT DISTINCT ON (site, box, machine, alarm) *
FROM daqsvc.alarm_events
ORDER BY site, box, machine, alarm, sequence DESC;
