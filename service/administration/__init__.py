"""Administration besides maps: the keys and the audit trail."""
