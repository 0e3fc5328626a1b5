"""Frames of a video, with a stand-in for what decodes it."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from sgwarp.errors import InputError
from sgwarp.reconstruction.sfm import video


class Film:
    """A video of so many gray frames, which grow sharper within each `period`."""

    def __init__(self, count: int, period: int = 1) -> None:
        self.count, self.at, self.period, self.released = count, 0, period, 0

    def get(self, key):
        return self.count

    def read(self):
        if self.at == self.count:
            return False, None
        frame = np.full((8, 8, 3), 100, np.uint8)
        frame[::2] += np.uint8(10 * (self.at % self.period) + 5)
        self.at += 1
        return True, frame

    def release(self):
        self.released += 1


@pytest.fixture
def film_file(tmp_path):
    """The file that a stand-in for OpenCV does not read."""
    path = tmp_path / "film.mp4"
    path.touch()
    return path


@pytest.mark.parametrize(
    ("count", "every", "kept"),
    [(30, None, 10), (450, None, 150), (600, None, 150), (1500, None, 150), (30, 1, 30), (31, 10, 4)],
)
def test_frames_of_a_video(monkeypatch, tmp_path, film_file, count, every, kept):
    """About 150 of them, but at most one of three, unless the interval is given."""
    written = []
    monkeypatch.setattr(cv2, "VideoCapture", lambda name: Film(count))
    monkeypatch.setattr(cv2, "imwrite", lambda name, frame, options: written.append((Path(name).name, options)))
    assert video.extract_frames(film_file, tmp_path / "frames", every) == kept
    assert [name for name, _ in written] == [f"{k:05d}.jpg" for k in range(kept)]
    assert all(options == [cv2.IMWRITE_JPEG_QUALITY, 95] for _, options in written)


def test_a_video_of_few_frames_is_refused(monkeypatch, tmp_path, film_file):
    monkeypatch.setattr(cv2, "VideoCapture", lambda name: Film(6))
    monkeypatch.setattr(cv2, "imwrite", lambda *rest: True)
    with pytest.raises(InputError, match="6 frames can be read, of which 2 remain"):
        video.extract_frames(film_file, tmp_path / "frames")
    assert sorted(tmp_path.iterdir()) == [film_file]
    with pytest.raises(InputError, match="--every: expected at least 1, got 0"):
        video.extract_frames(film_file, tmp_path / "frames", 0)


def test_the_sharpest_frame_stands_for_its_interval(monkeypatch, tmp_path, film_file):
    written = []
    monkeypatch.setattr(cv2, "VideoCapture", lambda name: Film(12, 4))
    monkeypatch.setattr(cv2, "imwrite", lambda name, frame, options: written.append(int(frame.max())))
    assert video.extract_frames(film_file, tmp_path / "frames", 4) == 3
    assert written == [135] * 3


def test_a_long_name_of_a_video_is_one(tmp_path):
    for name, expected in (("a.MP4", True), ("a.webm", True), ("a.mov", True), ("a.mp4.txt", False), ("mp4", False)):
        (tmp_path / name).touch()
        assert video.is_video(tmp_path / name) == expected
    (tmp_path / "folder.mp4").mkdir()
    assert not video.is_video(tmp_path / "folder.mp4")
    assert not video.is_video(tmp_path / "missing.mp4")


def test_a_video_is_read_to_its_end_and_let_go(monkeypatch, tmp_path, film_file):
    """Into folders that are made, past what an interrupted run has left; more frames may come than are announced."""
    film, reports = Film(12), []
    film.get = lambda key: 10
    monkeypatch.setattr(cv2, "VideoCapture", lambda name: film)
    monkeypatch.setattr(cv2, "imwrite", lambda name, *rest: Path(name).touch())
    folder = tmp_path / "a" / "b" / "frames"
    partial = folder.with_name(".frames.partial")
    partial.mkdir(parents=True)
    (partial / "00099.jpg").touch()
    with pytest.raises(FileExistsError):
        partial.mkdir()
    video.extract_frames(film_file, folder, 4, lambda *call: reports.append(call))
    assert film.released == 1
    assert reports == [(done, max(done, 10), "reading the video") for done in (4, 8, 12)]
    assert sorted(path.name for path in folder.iterdir()) == ["00000.jpg", "00001.jpg", "00002.jpg", "frames.json"]
    assert [path.name for path in folder.parent.iterdir()] == ["frames"]
    other = tmp_path / "c" / "d" / "frames"
    monkeypatch.setattr(cv2, "VideoCapture", lambda name: Film(9))
    assert video.extract_frames(film_file, other, 3) == 3


def test_a_video_that_fails_is_let_go(monkeypatch, tmp_path, film_file):
    film = Film(12)
    monkeypatch.setattr(cv2, "VideoCapture", lambda name: film)

    def fail(*arguments):
        raise KeyboardInterrupt

    monkeypatch.setattr(cv2, "imwrite", fail)
    with pytest.raises(KeyboardInterrupt):
        video.extract_frames(film_file, tmp_path / "frames", 3)
    assert film.released == 1


def test_sharpness_is_judged_at_480_pixels(tmp_path):
    """Noise of single pixels, as sensors make it, is no sharpness; a picture that is small enough is not enlarged."""
    random = np.random.default_rng(0)

    def blocks(size: int, width: int, strength: int) -> np.ndarray:
        values = random.integers(0, strength, (4, width // size), np.uint8)
        return np.repeat(np.kron(values, np.ones((size, size), np.uint8))[..., None], 3, axis=2)

    assert video._sharpness(blocks(2, 960, 100)) > video._sharpness(blocks(1, 960, 130))
    exact = blocks(1, 480, 200)
    assert video._sharpness(exact) == cv2.Laplacian(exact[..., 0], cv2.CV_32F).var()
    for width in (482, 960, 1440):
        frame = blocks(2, width, 200)
        small = cv2.resize(frame[..., 0], (480, round(480 * 8 / width)), interpolation=cv2.INTER_AREA)
        assert video._sharpness(frame) == cv2.Laplacian(small, cv2.CV_32F).var()
    assert np.isfinite(video._sharpness(blocks(1, 4000, 200)[:1]))  # one line
    assert video._sharpness(np.full((8, 8, 3), 9, np.uint8)) == 0
