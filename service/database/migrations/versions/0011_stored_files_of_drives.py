"""Committed drives know how many files they have, and their size."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0011"
down_revision = "0010"
branch_labels = None
depends_on = None

_COUNTED = """
    UPDATE drives SET
        files_stored = (SELECT count(*) FROM drive_files AS f WHERE f.drive_id = drives.id AND f.blob_id IS NOT NULL),
        bytes_stored = (
            SELECT CAST(coalesce(sum(b.size_bytes), 0) AS bigint)
            FROM drive_files AS f JOIN blobs AS b ON b.id = f.blob_id WHERE f.drive_id = drives.id
        )
    WHERE state = 'COMMITTED'
"""


def upgrade() -> None:
    """Upgrade to this version: drives that are committed are counted once."""
    with op.batch_alter_table("drives") as drives:
        drives.add_column(sa.Column("files_stored", sa.BigInteger(), nullable=True))
        drives.add_column(sa.Column("bytes_stored", sa.BigInteger(), nullable=True))
    op.execute(_COUNTED)


def downgrade() -> None:
    """Return to the version before, which counts them each time."""
    with op.batch_alter_table("drives") as drives:
        drives.drop_column("bytes_stored")
        drives.drop_column("files_stored")
