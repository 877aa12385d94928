"""Exports of scenes and maps."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0008"
down_revision = "0007"
branch_labels = None
depends_on = None


def upgrade() -> None:
    """Upgrade to this version."""
    op.create_table(
        "exports",
        sa.Column("id", sa.String(length=40), nullable=False),
        sa.Column("project_id", sa.String(length=40), nullable=False),
        sa.Column("scene_id", sa.String(length=40), nullable=True),
        sa.Column("map_id", sa.String(length=40), nullable=True),
        sa.Column("map_version", sa.BigInteger(), nullable=True),
        sa.Column("job_id", sa.String(length=40), nullable=False),
        sa.Column("fence", sa.BigInteger(), nullable=True),
        sa.Column("inputs_sha256", sa.String(length=64), nullable=False),
        sa.Column("formats", sa.JSON(), nullable=False),
        sa.Column("options", sa.JSON(), nullable=False),
        sa.Column("results", sa.JSON(), nullable=True),
        sa.Column("created_us", sa.BigInteger(), nullable=False),
        sa.Column("expires_us", sa.BigInteger(), nullable=True),
        sa.ForeignKeyConstraint(
            ["map_id", "map_version"],
            ["map_versions.map_id", "map_versions.number"],
            name=op.f("fk_exports_map_id_map_versions"),
            ondelete="CASCADE",
        ),
        sa.ForeignKeyConstraint(["project_id"], ["projects.id"], name=op.f("fk_exports_project_id_projects")),
        sa.ForeignKeyConstraint(
            ["scene_id"], ["scenes.id"], name=op.f("fk_exports_scene_id_scenes"), ondelete="CASCADE"
        ),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_exports")),
    )
    for columns in (
        ["project_id", "created_us", "id"],
        ["project_id", "inputs_sha256"],
        ["map_id", "map_version"],
        ["scene_id"],
        ["job_id"],
        ["expires_us"],
    ):
        op.create_index(op.f(f"ix_exports_{'_'.join(columns)}"), "exports", columns)
    op.create_table(
        "export_files",
        sa.Column("export_id", sa.String(length=40), nullable=False),
        sa.Column("path", sa.String(length=1024), nullable=False),
        sa.Column("blob_id", sa.String(length=40), nullable=False),
        sa.Column("media_type", sa.String(length=100), nullable=False),
        sa.ForeignKeyConstraint(["blob_id"], ["blobs.id"], name=op.f("fk_export_files_blob_id_blobs")),
        sa.ForeignKeyConstraint(
            ["export_id"], ["exports.id"], name=op.f("fk_export_files_export_id_exports"), ondelete="CASCADE"
        ),
        sa.PrimaryKeyConstraint("export_id", "path", name=op.f("pk_export_files")),
    )
    op.create_index(op.f("ix_export_files_blob_id"), "export_files", ["blob_id"])


def downgrade() -> None:
    """Return to the version before. Exports are lost; they can be made again."""
    op.drop_table("export_files")
    op.drop_table("exports")
    exports = "SELECT id FROM jobs WHERE kind = 'EXPORT'"
    for table in ("job_attempts", "job_events"):
        op.execute(f"DELETE FROM {table} WHERE job_id IN ({exports})")
    op.execute("DELETE FROM jobs WHERE kind = 'EXPORT'")
