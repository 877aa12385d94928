"""Resumable uploads, aggregations and maps."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0002"
down_revision = "0001"
branch_labels = None
depends_on = None

_JOB_COLUMNS = ("map_id", "request", "map_version", "is_child", "waiting_for", "children_percent")
_DEFAULTED = ("is_child", "waiting_for", "children_percent")


def upgrade() -> None:
    """Upgrade to this version."""
    with op.batch_alter_table("jobs") as jobs:
        jobs.alter_column("drive_id", existing_type=sa.String(length=40), nullable=True)
        jobs.add_column(sa.Column("map_id", sa.String(length=40), nullable=True))
        jobs.add_column(sa.Column("request", sa.JSON(), nullable=True))
        jobs.add_column(sa.Column("map_version", sa.BigInteger(), nullable=True))
        jobs.add_column(sa.Column("is_child", sa.Boolean(), nullable=False, server_default=sa.false()))
        jobs.add_column(sa.Column("waiting_for", sa.BigInteger(), nullable=False, server_default="0"))
        jobs.add_column(sa.Column("children_percent", sa.Double(), nullable=False, server_default="0"))
        jobs.create_index(op.f("ix_jobs_map_id"), ["map_id"])
    with op.batch_alter_table("jobs") as jobs:  # the defaults were for the rows that are there
        for name in _DEFAULTED:
            jobs.alter_column(name, server_default=None)
    with op.batch_alter_table("scenes") as scenes:
        scenes.add_column(sa.Column("settings_sha256", sa.String(length=64), nullable=True))
    _create_uploads()
    _create_members()
    _create_maps()
    _create_parts_of_maps()


def _create_uploads() -> None:
    op.create_table(
        "uploads",
        sa.Column("id", sa.String(length=40), nullable=False),
        sa.Column("project_id", sa.String(length=40), nullable=False),
        sa.Column("drive_id", sa.String(length=40), nullable=False),
        sa.Column("path", sa.String(length=1024), nullable=True),
        sa.Column("size_bytes", sa.BigInteger(), nullable=False),
        sa.Column("sha256", sa.String(length=64), nullable=True),
        sa.Column("given_metadata", sa.String(length=8192), nullable=False),
        sa.Column("replace", sa.Boolean(), nullable=False),
        sa.Column("kept_bytes", sa.BigInteger(), nullable=False),
        sa.Column("tail_boot", sa.String(length=40), nullable=True),
        sa.Column("is_done", sa.Boolean(), nullable=False),
        sa.Column("created_us", sa.BigInteger(), nullable=False),
        sa.Column("expires_us", sa.BigInteger(), nullable=False),
        sa.ForeignKeyConstraint(
            ["drive_id"], ["drives.id"], name=op.f("fk_uploads_drive_id_drives"), ondelete="CASCADE"
        ),
        sa.ForeignKeyConstraint(["project_id"], ["projects.id"], name=op.f("fk_uploads_project_id_projects")),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_uploads")),
    )
    for column in ("project_id", "drive_id", "expires_us"):
        op.create_index(op.f(f"ix_uploads_{column}"), "uploads", [column])


def _create_members() -> None:
    op.create_table(
        "job_members",
        sa.Column("job_id", sa.String(length=40), nullable=False),
        sa.Column("drive_id", sa.String(length=40), nullable=False),
        sa.Column("name", sa.String(length=100), nullable=False),
        sa.Column("child_id", sa.String(length=40), nullable=True),
        sa.Column("scene_id", sa.String(length=40), nullable=True),
        sa.Column("problem", sa.JSON(), nullable=True),
        sa.ForeignKeyConstraint(["job_id"], ["jobs.id"], name=op.f("fk_job_members_job_id_jobs"), ondelete="CASCADE"),
        sa.PrimaryKeyConstraint("job_id", "drive_id", name=op.f("pk_job_members")),
    )
    for column in ("child_id", "scene_id"):
        op.create_index(op.f(f"ix_job_members_{column}"), "job_members", [column])


def _create_maps() -> None:
    op.create_table(
        "maps",
        sa.Column("id", sa.String(length=40), nullable=False),
        sa.Column("project_id", sa.String(length=40), nullable=False),
        sa.Column("name", sa.String(length=200), nullable=False),
        sa.Column("current_version", sa.BigInteger(), nullable=True),
        sa.Column("newest_version", sa.BigInteger(), nullable=False),
        sa.Column("created_us", sa.BigInteger(), nullable=False),
        sa.Column("expires_us", sa.BigInteger(), nullable=True),
        sa.ForeignKeyConstraint(["project_id"], ["projects.id"], name=op.f("fk_maps_project_id_projects")),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_maps")),
    )
    op.create_index(op.f("ix_maps_expires_us"), "maps", ["expires_us"])
    op.create_index(op.f("ix_maps_project_id_created_us_id"), "maps", ["project_id", "created_us", "id"])
    op.create_table(
        "map_versions",
        sa.Column("map_id", sa.String(length=40), nullable=False),
        sa.Column("number", sa.BigInteger(), autoincrement=False, nullable=False),
        sa.Column("job_id", sa.String(length=40), nullable=False),
        sa.Column("fence", sa.BigInteger(), nullable=False),
        sa.Column("summary", sa.JSON(), nullable=False),
        sa.Column("failed", sa.JSON(), nullable=False),
        sa.Column("created_us", sa.BigInteger(), nullable=False),
        sa.ForeignKeyConstraint(["map_id"], ["maps.id"], name=op.f("fk_map_versions_map_id_maps"), ondelete="CASCADE"),
        sa.PrimaryKeyConstraint("map_id", "number", name=op.f("pk_map_versions")),
        sa.UniqueConstraint("job_id", name=op.f("uq_map_versions_job_id")),
    )


def _create_parts_of_maps() -> None:
    op.create_table(
        "map_scenes",
        sa.Column("map_id", sa.String(length=40), nullable=False),
        sa.Column("number", sa.BigInteger(), autoincrement=False, nullable=False),
        sa.Column("name", sa.String(length=100), nullable=False),
        sa.Column("drive_id", sa.String(length=40), nullable=False),
        sa.Column("scene_id", sa.String(length=40), nullable=False),
        sa.Column("connected", sa.Boolean(), nullable=False),
        _version_of("map_scenes"),
        sa.ForeignKeyConstraint(["scene_id"], ["scenes.id"], name=op.f("fk_map_scenes_scene_id_scenes")),
        sa.PrimaryKeyConstraint("map_id", "number", "name", name=op.f("pk_map_scenes")),
    )
    for column in ("drive_id", "scene_id"):
        op.create_index(op.f(f"ix_map_scenes_{column}"), "map_scenes", [column])
    op.create_table(
        "map_files",
        sa.Column("map_id", sa.String(length=40), nullable=False),
        sa.Column("number", sa.BigInteger(), autoincrement=False, nullable=False),
        sa.Column("path", sa.String(length=1024), nullable=False),
        sa.Column("blob_id", sa.String(length=40), nullable=False),
        sa.Column("media_type", sa.String(length=100), nullable=False),
        _version_of("map_files"),
        sa.ForeignKeyConstraint(["blob_id"], ["blobs.id"], name=op.f("fk_map_files_blob_id_blobs")),
        sa.PrimaryKeyConstraint("map_id", "number", "path", name=op.f("pk_map_files")),
    )
    op.create_index(op.f("ix_map_files_blob_id"), "map_files", ["blob_id"])
    op.create_table(
        "map_checkpoints",
        sa.Column("map_id", sa.String(length=40), nullable=False),
        sa.Column("inputs_sha256", sa.String(length=64), nullable=False),
        sa.Column("name", sa.String(length=100), nullable=False),
        sa.Column("project_id", sa.String(length=40), nullable=False),
        sa.Column("blob_id", sa.String(length=40), nullable=False),
        sa.Column("created_us", sa.BigInteger(), nullable=False),
        sa.ForeignKeyConstraint(["blob_id"], ["blobs.id"], name=op.f("fk_map_checkpoints_blob_id_blobs")),
        sa.ForeignKeyConstraint(
            ["map_id"], ["maps.id"], name=op.f("fk_map_checkpoints_map_id_maps"), ondelete="CASCADE"
        ),
        sa.ForeignKeyConstraint(["project_id"], ["projects.id"], name=op.f("fk_map_checkpoints_project_id_projects")),
        sa.PrimaryKeyConstraint("map_id", "inputs_sha256", "name", name=op.f("pk_map_checkpoints")),
    )
    op.create_index(op.f("ix_map_checkpoints_blob_id"), "map_checkpoints", ["blob_id"])
    by_inputs = ["project_id", "inputs_sha256"]
    op.create_index(op.f("ix_map_checkpoints_project_id_inputs_sha256"), "map_checkpoints", by_inputs)


def _version_of(table: str) -> sa.ForeignKeyConstraint:
    return sa.ForeignKeyConstraint(
        ["map_id", "number"],
        ["map_versions.map_id", "map_versions.number"],
        name=op.f(f"fk_{table}_map_id_map_versions"),
        ondelete="CASCADE",
    )


def downgrade() -> None:
    """Return to the version before. Aggregations and all that they made are lost."""
    for table in ("map_checkpoints", "map_files", "map_scenes", "map_versions", "maps", "job_members", "uploads"):
        op.drop_table(table)
    with op.batch_alter_table("scenes") as scenes:
        scenes.drop_column("settings_sha256")
    op.execute("DELETE FROM jobs WHERE drive_id IS NULL")
    with op.batch_alter_table("jobs") as jobs:
        jobs.drop_index(op.f("ix_jobs_map_id"))
        for column in _JOB_COLUMNS:
            jobs.drop_column(column)
        jobs.alter_column("drive_id", existing_type=sa.String(length=40), nullable=False)
