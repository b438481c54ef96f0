"""What an administrator manages besides maps: the keys and the audit trail."""
