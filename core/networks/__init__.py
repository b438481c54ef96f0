"""Networks: definitions, files, forward passes and identities."""
