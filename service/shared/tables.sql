-- What services share, in a schema of its own.  All moments are told by the database's clock.

CREATE SCHEMA IF NOT EXISTS service;


-- Statistics of answers, as in statistics.sqlite.
CREATE TABLE IF NOT EXISTS service.counted_maps (
    code bigint GENERATED ALWAYS AS IDENTITY PRIMARY KEY,
    id text COLLATE "C" NOT NULL,
    made text NOT NULL,
    since text NOT NULL,
    UNIQUE (id, made)
);
CREATE TABLE IF NOT EXISTS service.place_counts (
    map bigint NOT NULL REFERENCES service.counted_maps ON DELETE CASCADE,
    id text COLLATE "C" NOT NULL,
    best bigint NOT NULL,
    recognized bigint NOT NULL,
    last text COLLATE "C" NOT NULL,
    PRIMARY KEY (map, id)
);
CREATE TABLE IF NOT EXISTS service.week_counts (
    map bigint NOT NULL REFERENCES service.counted_maps ON DELETE CASCADE,
    monday text COLLATE "C" NOT NULL,
    counts jsonb NOT NULL,                  -- the columns of a week after its Monday
    PRIMARY KEY (map, monday)
);
CREATE TABLE IF NOT EXISTS service.hour_counts (
    map bigint NOT NULL REFERENCES service.counted_maps ON DELETE CASCADE,
    hour bigint NOT NULL,                   -- since 1970 UTC
    recognized bigint NOT NULL,
    ambiguous bigint NOT NULL,
    unknown bigint NOT NULL,
    PRIMARY KEY (map, hour)
);
CREATE TABLE IF NOT EXISTS service.calibrations (
    map bigint PRIMARY KEY REFERENCES service.counted_maps ON DELETE CASCADE,
    at text NOT NULL,
    report text NOT NULL,
    trials text NOT NULL
);

-- The latest answers.  A crash of PostgreSQL forgets them, as a restart of a service without it does.
CREATE UNLOGGED TABLE IF NOT EXISTS service.answers (
    number bigint GENERATED ALWAYS AS IDENTITY PRIMARY KEY,
    map text COLLATE "C" NOT NULL,
    made text NOT NULL,
    answer text NOT NULL
);
CREATE INDEX IF NOT EXISTS answers_of_map ON service.answers (map, made, number);

-- Which services have listeners of which maps, and the events that are on their way to them.
CREATE UNLOGGED TABLE IF NOT EXISTS service.listening (
    replica text COLLATE "C" NOT NULL,
    map text COLLATE "C" NOT NULL,
    pictures boolean NOT NULL,
    PRIMARY KEY (replica, map)
);
CREATE UNLOGGED TABLE IF NOT EXISTS service.events (
    number bigint GENERATED ALWAYS AS IDENTITY PRIMARY KEY,
    replica text COLLATE "C" NOT NULL,      -- that tells it
    map text COLLATE "C" NOT NULL,
    event text,                             -- NULL: the map was deleted
    at timestamptz NOT NULL DEFAULT clock_timestamp()
);
