"""Moving scenes: files in the layout that Dynamic3DGaussians publishes, written here by hand, and folders of PLY."""

import json
import zipfile

import numpy as np
import plyfile
import pytest
import torch

from sgwarp.errors import InputError
from sgwarp.io.archives import open_stacks
from sgwarp.io.moving_views import load_moving_views
from sgwarp.io.scenes import save_gaussians
from sgwarp.io.sequence_files import write_meta, write_params
from sgwarp.io.sequences import is_sequence, load_sequence
from sgwarp.scene import Camera, Gaussians, View

FRAMES, COUNT = 4, 6


def published(**changed):
    """Arrays of params.npz, of seeded random numbers."""
    random = np.random.default_rng(0)
    arrays = {
        "means3D": random.normal(size=(FRAMES, COUNT, 3)),
        "rgb_colors": random.uniform(size=(FRAMES, COUNT, 3)),
        "unnorm_rotations": random.normal(size=(FRAMES, COUNT, 4)),
        "seg_colors": np.eye(3)[[0, 2, 0, 2, 2, 0]],
        "logit_opacities": random.normal(size=(COUNT, 1)),
        "log_scales": random.normal(size=(COUNT, 3)),
        "cam_m": np.zeros((50, 3)),
        "cam_c": np.zeros((50, 3)),
    }
    arrays = {name: values.astype(np.float32) for name, values in arrays.items()}
    return {name: values for name, values in (arrays | changed).items() if values is not None}


@pytest.mark.parametrize("save", [np.savez, np.savez_compressed])
def test_params_hold_logits_logarithms_and_colors(tmp_path, save):
    arrays = published()
    save(tmp_path / "params.npz", **arrays)
    sequence = load_sequence(tmp_path / "params.npz")
    assert len(sequence) == FRAMES
    for index in (2, 0, 3, 3):  # backwards too
        frame = sequence.frame(index)
        gaussians = frame.gaussians
        assert np.array_equal(gaussians.means, arrays["means3D"][index])
        assert np.array_equal(gaussians.quats, arrays["unnorm_rotations"][index])
        assert np.allclose(gaussians.scales, np.exp(arrays["log_scales"]), rtol=1e-6)
        assert np.allclose(gaussians.opacities, 1 / (1 + np.exp(-arrays["logit_opacities"][:, 0])), rtol=1e-6)
        rgb = 0.28209479177387814 * gaussians.sh[:, 0].numpy() + 0.5
        assert np.allclose(rgb, arrays["rgb_colors"][index], atol=1e-6)
        assert frame.foreground.tolist() == [True, False, True, False, False, True]
        assert frame.ids is None


def test_a_folder_with_params_and_double_precision(tmp_path):
    arrays = {name: values.astype(np.float64) for name, values in published(seg_colors=None).items()}
    np.savez(tmp_path / "params.npz", **arrays)
    frame = load_sequence(tmp_path).frame(1)
    assert frame.gaussians.means.dtype == torch.float32
    assert frame.foreground is None
    assert is_sequence(tmp_path)


@pytest.mark.parametrize(("shift", "said"), [(0.0, 0), (5.4e6, 1)])
def test_positions_that_float32_cannot_hold_are_said_once(tmp_path, caplog, shift, said):
    means = published()["means3D"].astype(np.float64) + shift
    np.savez(tmp_path / "params.npz", **published(means3D=means, log_scales=np.full((COUNT, 3), -2.0, np.float32)))
    sequence = load_sequence(tmp_path / "params.npz")
    for index in range(FRAMES):
        sequence.frame(index)
    assert caplog.text.count("lies so far from the origin") == said


def test_scales_and_opacities_may_move(tmp_path):
    scales = np.random.default_rng(1).normal(size=(FRAMES, COUNT, 3)).astype(np.float32)
    np.savez(tmp_path / "params.npz", **published(log_scales=scales))
    frame = load_sequence(tmp_path / "params.npz").frame(2)
    assert np.allclose(frame.gaussians.scales, np.exp(scales[2]), rtol=1e-6)


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"log_scales": None}, "lacks the arrays log_scales"),
        ({"means3D": np.zeros((COUNT, 3), np.float32)}, "'means3D' has shape"),
        ({"rgb_colors": np.zeros((FRAMES, COUNT + 1, 3), np.float32)}, "'rgb_colors' is float32 of shape"),
        ({"unnorm_rotations": np.zeros((FRAMES, COUNT, 4), np.int64)}, "'unnorm_rotations' is int64"),
        ({"logit_opacities": np.array(["a"], dtype=object)}, "holds object"),
        ({"means3D": np.zeros((3, COUNT, FRAMES), np.float32).T}, "Fortran order"),
    ],
)
def test_what_params_must_be(tmp_path, changed, message):
    np.savez(tmp_path / "params.npz", **published(**changed))
    with pytest.raises(InputError, match=message):
        load_sequence(tmp_path / "params.npz")


def test_archives_that_are_damaged_or_lie(tmp_path):
    path = tmp_path / "params.npz"
    np.savez(path, **published())
    content = path.read_bytes()
    path.write_bytes(content[: len(content) // 2])
    with pytest.raises(InputError, match=r"is not an \.npz archive"):
        load_sequence(path)
    path.write_bytes(b"nothing of the kind")
    with pytest.raises(InputError, match=r"is not an \.npz archive"):
        load_sequence(path)
    with pytest.raises(InputError, match="no such file"):
        load_sequence(tmp_path / "other.npz")


def test_a_shape_that_the_archive_does_not_hold_takes_no_memory(tmp_path):
    path = tmp_path / "params.npz"
    np.savez(path, **published())
    huge = tmp_path / "huge.npz"
    with zipfile.ZipFile(path) as source, zipfile.ZipFile(huge, "w") as target:
        for member in source.namelist():
            data = source.read(member)
            if member == "means3D.npy":
                data = data.replace(b"(4, 6, 3), }          ", b"(40000000000, 6, 3), }")
            target.writestr(member, data)
    with pytest.raises(InputError, match=r"'means3D' of shape .* needs 2880000000128 bytes, the archive holds"):
        load_sequence(huge)


@pytest.mark.parametrize(("place", "value", "said"), [(8, 1, "password"), (10, 99, "compression")])
def test_members_with_a_password_or_an_unknown_packing(tmp_path, place, value, said):
    path = tmp_path / "params.npz"
    np.savez_compressed(path, a=np.arange(60, dtype=np.float32).reshape(3, 4, 5))
    content = bytearray(path.read_bytes())
    content[content.index(b"PK\x01\x02") + place] = value  # in the directory at the end
    path.write_bytes(content)
    with pytest.raises(InputError, match=rf"params.npz: is not an .npz archive of arrays \(.*{said}"):
        open_stacks(path)


def test_slices_are_read_where_they_lie(tmp_path):
    """Of a stored array only the slice is read: a frame behind a damaged one is fine."""
    path = tmp_path / "a.npz"
    values = np.arange(60, dtype=np.float32).reshape(3, 4, 5)
    np.savez(path, a=values)
    array = open_stacks(path)["a"]
    assert (array.shape, array.row_bytes) == ((3, 4, 5), 80)
    assert np.array_equal(array.row(2), values[2])
    assert np.array_equal(array.whole(), values)
    with pytest.raises(IndexError):
        array.row(3)


def cloud(count, seed=0):
    random = torch.Generator().manual_seed(seed)
    return Gaussians(
        torch.randn(count, 3, generator=random),
        torch.randn(count, 4, generator=random),
        torch.rand(count, 3, generator=random) + 0.1,
        torch.rand(count, generator=random) * 0.8 + 0.1,
        torch.randn(count, 4, 3, generator=random),
    )


def test_a_folder_of_ply_is_ordered_by_number(tmp_path):
    for number in (10, 9, 100):
        save_gaussians(cloud(number), tmp_path / f"frame_{number}.ply")
    sequence = load_sequence(tmp_path)
    assert [len(sequence.frame(k).gaussians) for k in range(3)] == [9, 10, 100]
    assert sequence.frame(0).ids is None


def with_column(path, name, values):
    rows = plyfile.PlyData.read(str(path))["vertex"].data
    wider = np.empty(len(rows), dtype=[*rows.dtype.descr, (name, values.dtype.str)])
    for field in rows.dtype.names:
        wider[field] = rows[field]
    wider[name] = values
    plyfile.PlyData([plyfile.PlyElement.describe(wider, "vertex")]).write(str(path))


def test_ids_of_ply_files(tmp_path):
    path = tmp_path / "0.ply"
    save_gaussians(cloud(5), path)
    with_column(path, "id", np.array([7, 3, 9, 1, 2], np.int32))
    frame = load_sequence(tmp_path).frame(0)
    assert frame.ids.tolist() == [7, 3, 9, 1, 2]
    assert torch.equal(frame.gaussians.means, cloud(5).means)
    with_column(path, "gaussian_id", np.array([7, 3, 7, 1, 2], np.int32))
    assert load_sequence(tmp_path).frame(0).ids.tolist() == [7, 3, 9, 1, 2]  # the first of the names


def test_ids_must_be_unique_integers(tmp_path):
    save_gaussians(cloud(3), tmp_path / "0.ply")
    save_gaussians(cloud(3), tmp_path / "1.ply")
    with_column(tmp_path / "0.ply", "id", np.array([4, 4, 1], np.int32))
    with_column(tmp_path / "1.ply", "id", np.array([4, 2, 1], np.float32))
    sequence = load_sequence(tmp_path)
    with pytest.raises(InputError, match="names a Gaussian twice"):
        sequence.frame(0)
    with pytest.raises(InputError, match="expected integers"):
        sequence.frame(1)


def test_a_ply_without_rows_is_a_frame_without_gaussians(tmp_path):
    save_gaussians(cloud(3), tmp_path / "0.ply")
    rows = plyfile.PlyData.read(str(tmp_path / "0.ply"))["vertex"].data[:0]
    plyfile.PlyData([plyfile.PlyElement.describe(rows, "vertex")]).write(str(tmp_path / "1.ply"))
    assert len(load_sequence(tmp_path).frame(1).gaussians) == 0


def test_nothing_to_open(tmp_path):
    with pytest.raises(InputError, match=r"neither params\.npz nor \.ply"):
        load_sequence(tmp_path)
    (tmp_path / "a.txt").write_text("")
    with pytest.raises(InputError, match="is no sequence"):
        load_sequence(tmp_path / "a.txt")


def test_what_is_written_reads_back(tmp_path):
    first = cloud(4)
    first = Gaussians(first.means, first.quats, first.scales, first.opacities, first.sh[:, :1])
    second = Gaussians(first.means + 1, first.quats, first.scales, first.opacities, first.sh * 0.5)
    write_params(tmp_path / "params.npz", [first, second], torch.tensor([True, False, True, True]))
    with np.load(tmp_path / "params.npz") as stored:
        assert stored["means3D"].shape == (2, 4, 3)
        assert stored["logit_opacities"].shape == (4, 1)
        assert set(published()) <= set(stored.files)
    frame = load_sequence(tmp_path).frame(1)
    for name in ("means", "quats", "scales", "opacities", "sh"):
        assert torch.allclose(getattr(frame.gaussians, name), getattr(second, name), rtol=1e-5, atol=1e-6)
    assert frame.foreground.tolist() == [True, False, True, True]
    with pytest.raises(InputError, match="frame 1 has other"):
        write_params(tmp_path / "b.npz", [first, cloud(4, seed=1)])


def meta(**changed):
    pose, lens = np.eye(4).tolist(), [[50.0, 0, 31.0], [0, 51.0, 17.5], [0, 0, 1]]
    other = np.eye(4)
    other[0, 3] = 1.5
    content = {
        "w": 64,
        "h": 36,
        "k": [[lens, lens]] * 2,
        "w2c": [[pose, pose], [pose, other.tolist()]],
        "fn": [["3/000000.jpg", "7/000000.jpg"], ["3/000001.jpg", "7/000001.jpg"]],
        "cam_id": [[3, 7]] * 2,
    }
    return {name: value for name, value in (content | changed).items() if value is not None}


def test_meta_files(tmp_path):
    (tmp_path / "train_meta.json").write_text(json.dumps(meta()))
    views = load_moving_views(tmp_path)
    assert views.frames == 2
    found = views.at(1)
    assert [one.view.stem for one in found] == ["3", "7"]
    assert found[1].view.camera.world_to_camera[0, 3] == 1.5
    assert found[1].view.camera.K[0, 2] == 31.0  # off centre, and kept
    assert found[1].file == "7/000001.jpg"
    assert (found[1].view.image_path, found[1].missing) == (None, False)  # there are no photographs at all
    (tmp_path / "ims" / "7").mkdir(parents=True)
    (tmp_path / "ims" / "7" / "000001.jpg").write_bytes(b"")
    found = views.at(1)
    assert [one.missing for one in found] == [True, False]
    assert found[1].view.image_path == tmp_path / "ims" / "7" / "000001.jpg"
    assert not any(one.missing for one in load_moving_views(tmp_path, photographs=False).at(1))


@pytest.mark.parametrize("scale", [1e-3, 1e4])
def test_near_planes_of_meta_files_follow_the_unit(tmp_path, scale):
    poses = [np.eye(4) for _ in range(3)]
    for place, pose in zip((-1.0, 0.0, 1.0), poses, strict=True):
        pose[0, 3] = scale * place
    lens = [[50.0, 0, 31.0], [0, 51.0, 17.5], [0, 0, 1]]
    row = [pose.tolist() for pose in poses]
    content = {"w": 64, "h": 36, "k": [[lens] * 3] * 2, "w2c": [row, row]}
    (tmp_path / "train_meta.json").write_text(json.dumps(content))
    for frame in (0, 1):
        for one in load_moving_views(tmp_path).at(frame):
            assert one.view.camera.near == pytest.approx(0.01 * 1.1 * scale)


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"w": None}, "has no 'w'"),
        ({"h": 3.5}, "'h' must be a positive whole number"),
        ({"k": [[]]}, "'k' must have one list per frame"),
        ({"fn": [["a.jpg"]] * 2}, "frame 1: 'fn' must have one entry per camera"),
        ({"cam_id": [[3, 3]] * 2}, "another view named '3'"),
        ({"cam_id": [["../x", 3]] * 2}, "plain name"),
        ({"w2c": [[np.zeros((4, 4)).tolist()] * 2] * 2}, "frame 1, camera 0"),
        ({"w2c": []}, "has no frames"),
    ],
)
def test_what_meta_files_must_be(tmp_path, changed, message):
    path = tmp_path / "test_meta.json"
    content = meta(**changed)
    if "w2c" in changed and not changed["w2c"]:
        content |= {"k": [], "fn": [], "cam_id": []}
    path.write_text(json.dumps(content))
    with pytest.raises(InputError, match=message):
        load_moving_views(tmp_path, "test").at(1)


def test_meta_without_names_of_cameras(tmp_path):
    path = tmp_path / "train_meta.json"
    path.write_text(json.dumps(meta(cam_id=None)))
    assert [one.view.stem for one in load_moving_views(path).at(0)] == ["3", "7"]
    path.write_text(json.dumps(meta(cam_id=None, fn=None)))
    assert [one.view.stem for one in load_moving_views(path).at(0)] == ["0", "1"]
    path.write_text("{")
    with pytest.raises(InputError, match="not valid JSON"):
        load_moving_views(path)


def still_camera():
    return Camera(torch.tensor([[50.0, 0, 30], [0, 50, 20], [0, 0, 1]]), torch.eye(4), 64, 36)


def test_meta_written_reads_back(tmp_path):
    write_meta(tmp_path / "train_meta.json", [View("12", still_camera())], 3)
    views = load_moving_views(tmp_path)
    assert views.frames == 3
    assert views.at(2)[0].file == "12/000002.jpg"
    assert torch.equal(views.at(2)[0].view.camera.K, still_camera().K)


def transforms(*names):
    frames = [{"file_path": name, "transform_matrix": np.eye(4).tolist()} for name in names]
    return json.dumps({"w": 8, "h": 6, "fl_x": 7.0, "frames": frames})


def test_cameras_that_stay(tmp_path):
    (tmp_path / "transforms.json").write_text(transforms("images/a.png", "images/b.png"))
    views = load_moving_views(tmp_path)
    assert views.frames is None
    assert [one.view.stem for one in views.at(99)] == ["a", "b"]
    assert views.at(0)[0].view.image_path is None
    for frame in (0, 1):
        (tmp_path / "images" / f"{frame:05d}").mkdir(parents=True)
    (tmp_path / "images" / "00000" / "a.png").write_bytes(b"")
    (tmp_path / "images" / "00001" / "b.png").write_bytes(b"")
    found = load_moving_views(tmp_path).at(1)
    assert [one.missing for one in found] == [True, False]
    assert found[1].view.image_path == tmp_path / "images" / "00001" / "b.png"


def test_a_folder_of_views_per_frame(tmp_path):
    for name in ("2", "10"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "transforms.json").write_text(transforms(f"x{name}.png"))
    views = load_moving_views(tmp_path, photographs=False)
    assert views.frames == 2
    assert [views.at(k)[0].view.stem for k in (0, 1)] == ["x2", "x10"]
