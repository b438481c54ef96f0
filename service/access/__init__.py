"""Who may do what: keys, roles, rates, the audit trail."""
