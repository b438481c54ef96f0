-- What PostgreSQL has of the maps (core.milvus.ledger has the statements).

CREATE TABLE IF NOT EXISTS placerec (
    single boolean PRIMARY KEY DEFAULT true CHECK (single),
    version integer NOT NULL,
    objects text NOT NULL DEFAULT gen_random_uuid()::text, -- the folder of its pictures
    swept bigint NOT NULL DEFAULT 0,    -- no object with a smaller key is litter,
    listed timestamptz                  -- as it was when all objects were last listed
);
INSERT INTO placerec (version) VALUES (2);

CREATE TABLE IF NOT EXISTS maps (
    number bigint GENERATED ALWAYS AS IDENTITY PRIMARY KEY,
    id text COLLATE "C" NOT NULL UNIQUE,
    record text NOT NULL,               -- MapRecord as JSON
    listed boolean NOT NULL DEFAULT true, -- false: it is being built
    touched timestamptz NOT NULL DEFAULT now(), -- of the last write
    places bigint NOT NULL DEFAULT 0,   -- how many there are
    rows bigint NOT NULL DEFAULT 0,     -- the number of the next row
    codes integer NOT NULL DEFAULT 0,   -- the code of the next sequence or lost track
    writes bigint NOT NULL DEFAULT 0,   -- grows with every write
    inserted bigint NOT NULL DEFAULT 0, -- Milvus's timestamp of the last insertion that counts
    collection bigint NOT NULL DEFAULT 0 -- Milvus's id of the collection that has its descriptors; 0: none has, or it
                                        -- was not noted
);

-- The code of the places without a sequence is -1, and their sequence has no name.
CREATE TABLE IF NOT EXISTS sequences (
    map bigint NOT NULL REFERENCES maps ON DELETE CASCADE,
    code integer NOT NULL,
    name text COLLATE "C",
    next_ordinal bigint NOT NULL DEFAULT 0,
    PRIMARY KEY (map, code),
    UNIQUE (map, name)
);

-- The numbers of places and the keys of Milvus's entities are never used twice, also if their transaction fails.
CREATE SEQUENCE IF NOT EXISTS keys;

CREATE TABLE IF NOT EXISTS places (
    map bigint NOT NULL REFERENCES maps ON DELETE CASCADE,
    number bigint NOT NULL,             -- grows in the order of enrolment
    id text COLLATE "C" NOT NULL,
    row bigint NOT NULL,                -- of its frame
    key bigint NOT NULL UNIQUE,         -- of its entity in Milvus
    digest bytea NOT NULL,
    picture text NOT NULL,              -- what is kept of its frame
    place text NOT NULL,                -- Place as JSON
    sequence integer NOT NULL,
    ordinal bigint NOT NULL,
    camera text COLLATE "C",
    moment bigint,                      -- its timestamp, microseconds since 1970
    tokens text[] NOT NULL,             -- of its metadata
    track integer,                      -- the sequence whose frames show what it shows, and where in it
    station bigint,
    pose_of text COLLATE "C",           -- the id of the place whose pose it got
    PRIMARY KEY (map, number),
    UNIQUE (map, id),
    UNIQUE (map, row)
);
CREATE INDEX IF NOT EXISTS places_at_position ON places (map, sequence, ordinal, number);
CREATE INDEX IF NOT EXISTS places_in_order ON places (map, sequence, number);
CREATE INDEX IF NOT EXISTS places_by_metadata ON places USING gin (tokens);

-- Apart from the places, so that a listing need not read them.
CREATE TABLE IF NOT EXISTS frames (
    map bigint NOT NULL REFERENCES maps ON DELETE CASCADE,
    row bigint NOT NULL,
    descriptor bytea NOT NULL,          -- [D], in the map's precision
    local bytea NOT NULL,               -- [C, L], likewise
    keypoints bytea,
    picture bytea,                      -- unless it is in an object store
    object text COLLATE "C" UNIQUE,     -- the name of its picture there
    object_size bigint,
    object_digest bytea,                -- SHA-256
    PRIMARY KEY (map, row)
);
ALTER TABLE frames ALTER COLUMN descriptor SET STORAGE EXTERNAL; -- compressing them would only take time

-- What no place names any more; it is deleted a while later, for a query may still need it.
CREATE TABLE IF NOT EXISTS leavings (
    map bigint NOT NULL REFERENCES maps ON DELETE CASCADE,
    key bigint PRIMARY KEY,
    row bigint,                         -- of a frame that can be deleted; NULL: the frame is still a place's
    since timestamptz NOT NULL DEFAULT now()
);
CREATE INDEX IF NOT EXISTS leavings_of_map ON leavings (map, since);

CREATE TABLE IF NOT EXISTS cameras (
    map bigint NOT NULL REFERENCES maps ON DELETE CASCADE,
    name text COLLATE "C" NOT NULL,
    record text NOT NULL,               -- CameraRecord as JSON
    PRIMARY KEY (map, name)
);

-- The frames that are kept to be reviewed; they go with their map.
CREATE TABLE IF NOT EXISTS review_frames (
    map bigint NOT NULL REFERENCES maps ON DELETE CASCADE,
    number bigint NOT NULL,             -- grows
    at timestamptz NOT NULL,
    digest bytea NOT NULL,
    size bigint NOT NULL,
    answer text NOT NULL,               -- JSON
    label text,                         -- JSON
    object text COLLATE "C" UNIQUE,     -- the name of its picture in the store, instead of that in review_pictures
    PRIMARY KEY (map, number),
    UNIQUE (map, digest)
);
CREATE TABLE IF NOT EXISTS review_pictures (
    map bigint NOT NULL,
    number bigint NOT NULL,
    bytes bytea NOT NULL,
    PRIMARY KEY (map, number),
    FOREIGN KEY (map, number) REFERENCES review_frames ON DELETE CASCADE
);

-- The objects whose row is deleted; a sweep deletes them.
CREATE TABLE IF NOT EXISTS dead_objects (name text COLLATE "C" PRIMARY KEY);
CREATE OR REPLACE FUNCTION note_dead_object() RETURNS trigger LANGUAGE plpgsql AS $$
BEGIN
    INSERT INTO dead_objects (name) VALUES (OLD.object) ON CONFLICT DO NOTHING;
    RETURN NULL;
END $$;
DROP TRIGGER IF EXISTS frame_deleted ON frames;
CREATE TRIGGER frame_deleted AFTER DELETE ON frames
    FOR EACH ROW WHEN (OLD.object IS NOT NULL) EXECUTE FUNCTION note_dead_object();
DROP TRIGGER IF EXISTS review_frame_deleted ON review_frames;
CREATE TRIGGER review_frame_deleted AFTER DELETE ON review_frames
    FOR EACH ROW WHEN (OLD.object IS NOT NULL) EXECUTE FUNCTION note_dead_object();
