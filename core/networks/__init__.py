"""Networks: definitions, forward passes, identities, and the import of networks trained with other software."""
