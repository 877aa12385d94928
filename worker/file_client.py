"""Asks the supervisor of this child for files of the drive."""

from __future__ import annotations

import json
import socket
from dataclasses import dataclass

from mrasfm_engine.errors import StorageError
from worker.child_protocol import FileAddress


@dataclass(frozen=True)
class FilesOnDemand:
    """Waits until a file of the drive, by its name, is in its folder. Other processes may be given a copy."""

    address: FileAddress

    def __call__(self, file: str) -> None:
        """Return when the file is there.

        Raises
        ------
        StorageError
            Where it does not come.
        """
        try:
            with socket.create_connection(("127.0.0.1", self.address.port)) as connection:
                connection.sendall(json.dumps({"token": self.address.token, "file": file}).encode() + b"\n")
                with connection.makefile("rb") as answers:
                    error = json.loads(answers.readline())["error"]
        except (OSError, ValueError) as problem:
            error = type(problem).__name__
        if error is not None:
            raise StorageError(
                f"file {file} of the drive does not come from the artifact store: {error}",
                remedy="Nothing needs to be done: the job is tried again. If it fails again, check the store.",
            )
