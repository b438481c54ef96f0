"""The live events of maps: queries, enrolments, sessions, jobs, changes of the map."""
