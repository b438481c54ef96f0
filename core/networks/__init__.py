"""Networks: definitions, forward passes, identities, and the import of files that others have trained."""
