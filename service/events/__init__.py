"""What happens in maps, as it happens: queries, enrolments, sessions, jobs, changes of the map."""
