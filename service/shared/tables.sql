-- What services share, in a schema of its own.  All moments are told by the database's clock.

CREATE SCHEMA IF NOT EXISTS service;

CREATE TABLE IF NOT EXISTS service.sessions (
    id text COLLATE "C" PRIMARY KEY,
    map text COLLATE "C" NOT NULL,
    map_created_at text NOT NULL,
    options text NOT NULL,                  -- NewSession as JSON
    expires_after double precision NOT NULL,
    created timestamptz NOT NULL DEFAULT clock_timestamp(),
    used timestamptz NOT NULL DEFAULT clock_timestamp(),
    number bigint,
    moment double precision,
    request text,
    lost bigint,
    ended text,                             -- why; NULL while it lives
    begun_by text,                          -- who, with which request, as JSON
    revision bigint NOT NULL DEFAULT 0,     -- grows with every frame
    state bytea,
    answer text
);
CREATE INDEX IF NOT EXISTS living_sessions ON service.sessions (map) WHERE ended IS NULL;
CREATE INDEX IF NOT EXISTS ended_sessions ON service.sessions (used) WHERE ended IS NOT NULL;
ALTER TABLE service.sessions ALTER COLUMN state SET STORAGE EXTERNAL; -- compressing it would only take time

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
