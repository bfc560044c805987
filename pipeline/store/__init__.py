"""The artifact store: what is computed once stays, whole and unchanged, until nobody needs it."""

from pipeline.store.faults import file_in_the_way, is_disk_full
from pipeline.store.records import MANIFEST, read_own, write_sealed
from pipeline.store.results import CorruptResultError, Result
from pipeline.store.store import Store, partial_name

__all__ = [
    "MANIFEST",
    "CorruptResultError",
    "Result",
    "Store",
    "file_in_the_way",
    "is_disk_full",
    "partial_name",
    "read_own",
    "write_sealed",
]
