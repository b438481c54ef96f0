from tests.core.ledger.conftest import open_ledger

__all__ = ["open_ledger"]
