-- What services share, in a schema of its own.  All moments are told by the database's clock.

CREATE SCHEMA IF NOT EXISTS service;

-- As in keys.sqlite; each row has a checksum.
CREATE TABLE IF NOT EXISTS service.keys (
    id text COLLATE "C" PRIMARY KEY,
    name text COLLATE "C" NOT NULL,
    role text NOT NULL,
    maps text,
    digest bytea NOT NULL,
    created_at text COLLATE "C" NOT NULL,
    expires_at text,
    revoked_at text,
    seal bytea NOT NULL,
    last_used_at text COLLATE "C"
);

-- Numbers that grow with every change of something, so that nobody reads it in vain.
CREATE TABLE IF NOT EXISTS service.versions (
    name text PRIMARY KEY,
    number bigint NOT NULL
);
INSERT INTO service.versions VALUES ('keys', 0) ON CONFLICT DO NOTHING;

-- The audit trail: one JSON object a line.
CREATE TABLE IF NOT EXISTS service.audit (
    number bigint GENERATED ALWAYS AS IDENTITY PRIMARY KEY,
    replica text COLLATE "C" NOT NULL,
    line text NOT NULL
);

CREATE TABLE IF NOT EXISTS service.jobs (
    number bigint GENERATED ALWAYS AS IDENTITY PRIMARY KEY,
    id text COLLATE "C" NOT NULL UNIQUE,
    kind text NOT NULL,
    map text COLLATE "C",
    state text NOT NULL,
    arguments text NOT NULL,
    resumable boolean NOT NULL,
    cancelling boolean NOT NULL,
    attempt integer NOT NULL,
    change bigint NOT NULL,
    done bigint NOT NULL,
    total bigint,
    message text NOT NULL,
    notes text NOT NULL,
    result text,
    problem text,
    created_at timestamptz NOT NULL DEFAULT clock_timestamp(),
    started_at timestamptz,
    ended_at timestamptz,
    maps text NOT NULL,
    asker text NOT NULL,
    home text COLLATE "C",                  -- the only service that can do it; NULL: any
    owner text COLLATE "C",                 -- the service that does it
    behind bigint,                          -- it gave way to the jobs up to this number; NULL: never
    yielded bigint NOT NULL DEFAULT 0       -- orders those that gave way to the same ones; 0: never
);
CREATE INDEX IF NOT EXISTS open_jobs ON service.jobs (map, number) WHERE state IN ('queued', 'running');
CREATE SEQUENCE IF NOT EXISTS service.yields;

-- When the bucket of a caller will be full again.  A crash of PostgreSQL fills all of them.
CREATE UNLOGGED TABLE IF NOT EXISTS service.rates (
    name text COLLATE "C" PRIMARY KEY,
    full_at timestamptz NOT NULL
);

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
