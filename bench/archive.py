"""Zip archives from strangers: their members are listed and their sizes bounded before anything is unpacked."""

from __future__ import annotations

import io
import struct
import zipfile
from collections.abc import Iterable
from pathlib import Path

from cavbench import bounded
from cavbench.bounded import spelled
from cavbench.errors import UserError

LARGEST = 2**30
"""Most bytes that an archive may unpack to."""
RATIO, SMALL = 100, 2**20
"""An archive may unpack to 100 times its size, and to 1 MiB in any case: weights hardly compress, so more is a bomb."""
END, END_MARK = struct.Struct("<4s4H2IH"), b"PK\x05\x06"
"""The record at the end of an archive: disks, numbers of members, size and place of their list, length of a comment."""
MEMBERS = 20_000
"""Most members of an archive."""


class Archive:
    """The members of a zip file, unpacked into memory within the bounds of this module.

    The bounds are checked twice: on the sizes that the archive states, and on the bytes that come out of it, because a
    stated size can be wrong. What another reader might read otherwise is refused: two members whose names differ in case only
    (torch's reader ignores case), names with a zero byte, bytes before the first member or after the end, a list of members
    that is elsewhere than the end says.

    Args:
        content: the bytes of the archive.
        name: its name in errors.

    Raises:
        UserError: if it is not a zip file, is encrypted, or unpacks to more than is allowed.
    """

    def __init__(self, content: bytes, name: str) -> None:
        self.name = name
        try:
            with zipfile.ZipFile(io.BytesIO(content)) as archive:
                members = archive.infolist()
                self._check(members, len(content))
                if not _is_plain(content, archive):
                    raise UserError(
                        f"{name} cannot be read: it is not a zip archive alone, there is something before or after it"
                    )
                self.members = {member.filename: _unpacked(archive, member) for member in members}
        # A damaged archive can fail anywhere in the decompressors.
        except (zipfile.BadZipFile, OSError, EOFError, ValueError, NotImplementedError, RuntimeError) as error:
            raise UserError(f"{name} cannot be read: it is not a zip archive, or a damaged one") from error
        except Exception as error:
            if isinstance(error, UserError):
                raise
            raise UserError(f"{name} cannot be read: it is a damaged zip archive") from error

    @classmethod
    def read(cls, path: Path, name: str = "") -> Archive:
        """The archive in a file.

        Raises:
            UserError: if it is no regular file, is larger than an archive may unpack to, or as the constructor.
        """
        name = name or str(path)
        return cls(bounded.content(path, most=LARGEST, name=name), name)

    def member(self, name: str) -> bytes:
        """The content of a member.

        Raises:
            UserError: if there is no such member.
        """
        if name not in self.members:
            raise UserError(f"{self.name} cannot be read: it has no {name!r}")
        return self.members[name]

    def repacked(self) -> io.BytesIO:
        """A new archive with the same members, for a library with a zip reader of its own: it sees what was checked."""
        copy = io.BytesIO()
        with zipfile.ZipFile(copy, "w", zipfile.ZIP_STORED) as archive:
            for name, content in self.members.items():
                archive.writestr(name, content)
        copy.seek(0)
        return copy

    def _check(self, members: Iterable[zipfile.ZipInfo], size: int) -> None:
        members = list(members)
        total = sum(member.file_size for member in members)
        allowed = min(LARGEST, max(RATIO * size, SMALL))
        if total > allowed:
            raise UserError(
                f"{self.name} is refused: {spelled(size)} unpack to {spelled(total)}, more than the {spelled(allowed)} allowed"
            )
        if len(members) > MEMBERS:
            raise UserError(f"{self.name} is refused: it has {len(members)} members, at most {MEMBERS} are allowed")
        if len({member.filename.casefold() for member in members}) < len(members):
            raise UserError(
                f"{self.name} is refused: two of its members have the same name, but for upper and lower case"
            )
        if any(member.orig_filename != member.filename for member in members):
            raise UserError(f"{self.name} is refused: a member has a name that others read otherwise")


def _is_plain(content: bytes, archive: zipfile.ZipFile) -> bool:
    """Whether an archive fills its file, from the first member to the end record, and that record says what was read."""
    members = archive.infolist()
    mark, *_, count, _, start, comment = END.unpack(content[-END.size :])
    first = min((member.header_offset for member in members), default=archive.start_dir)
    whole = mark == END_MARK and not comment and first == 0
    # Records of more than 4 GiB or 65,535 members stand in a second one before, and the last may say "there".
    return whole and count in (len(members), 2**16 - 1) and start in (archive.start_dir, 2**32 - 1)


def _unpacked(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> bytes:
    """The content of a member; no more bytes are unpacked than it states."""
    with archive.open(member) as file:
        content = file.read(member.file_size + 1)
    if len(content) != member.file_size:
        raise zipfile.BadZipFile(f"{member.filename} has another size than it states")
    return content
