"""Stand-ins for the packages of pointmap models: their call signatures, with the truth as answer.

Each fake sees only what the real one sees (tensors and an index), and works out by itself which
part of the photograph they show. It answers with the true pointmap of the scene in `dense_scene`,
with noise, holes, outliers and a random similarity.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass, field, replace
from types import ModuleType

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from pipeline.artifacts.cameras import Camera
from tests.stages import dense_scene as scene


@dataclass
class Truth:
    """The scene, and what is wrong with the answers.

    Attributes:
        cameras: of the photographs, in their order.
        noise: standard deviation relative to the distance.
        outliers: share of wild points, of low confidence.
        hole: whether a corner of each map is NaN.
        long_side: that photographs are resized to before they are cut (the dust3r family); 0:
            they are resized until they cover the image.
    """

    cameras: list[Camera]
    noise: float = 0.0
    outliers: float = 0.0
    hole: bool = False
    long_side: int = 0
    random: np.random.Generator = field(default_factory=lambda: np.random.default_rng(0))
    calls: list[tuple] = field(default_factory=list)

    def seen(
        self, index: int, height: int, width: int, stretched: bool = False
    ) -> tuple[Camera, np.ndarray]:
        """The camera and depth of an image that shows the middle of photograph `index`.

        Resized to cover and cut in the middle, or stretched.
        """
        whole = self.cameras[index]
        across, down = width / whole.width, height / whole.height
        if not stretched:
            across = down = max(across, down)
        if self.long_side:
            across = down = self.long_side / max(whole.width, whole.height)
        part = replace(
            whole, width=width, height=height, cx=width / 2, cy=height / 2,
            fx=whole.fx * across, fy=whole.fy * down,
        )  # fmt: skip
        return part, scene.render(part)[1]

    def spoil(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Points [h, w, 3] with noise, outliers and a hole, and their confidence."""
        shape = points.shape[:2]
        points = points * (1 + self.noise * self.random.normal(size=(*shape, 1)))
        confidence = self.random.uniform(4, 12, shape)
        wild = self.random.random(shape) < self.outliers
        points[wild] *= self.random.uniform(0.5, 2, (wild.sum(), 1))
        confidence[wild] = 2
        if self.hole:
            points[: shape[0] // 8, : shape[1] // 8] = np.nan
        return points.astype(np.float32), confidence.astype(np.float32)


def local(camera: Camera, depth: np.ndarray, frame: Camera) -> np.ndarray:
    return camera.unproject(depth) @ frame.rotation.T + frame.translation


def module(monkeypatch, name: str, **contents) -> ModuleType:
    """Put a module and its parents where they are imported from."""
    parts = name.split(".")
    for k in range(1, len(parts) + 1):
        path = ".".join(parts[:k])
        if path not in sys.modules:
            monkeypatch.setitem(sys.modules, path, ModuleType(path))
    for key, value in contents.items():
        setattr(sys.modules[name], key, value)
    return sys.modules[name]


class Network:
    """What all models can: move to a device and stop training."""

    device = "nowhere"
    training = True

    def to(self, device):
        self.device = str(device)
        return self

    def eval(self):
        self.training = False
        return self


def fake_dust3r(monkeypatch, truth: Truth, top: str = "dust3r", name="AsymmetricCroCo3DStereo"):
    class Stereo(Network):
        @classmethod
        def from_pretrained(cls, path):
            truth.calls.append(("from_pretrained", path))
            return cls()

    def inference(pairs, model, device, batch_size=8, verbose=True):
        assert isinstance(model, Stereo) and not model.training
        assert batch_size == 1 and len(pairs) == 1
        (one, two), cameras, depths = pairs[0], [], []
        for view in (one, two):
            assert view["img"].dtype == torch.float32 and view["img"].ndim == 4
            assert -1 <= float(view["img"].min()) < 0 < float(view["img"].max()) <= 1
            height, width = view["img"].shape[-2:]
            assert height % 16 == 0 and width % 16 == 0
            assert view["true_shape"].tolist() == [[height, width]]
            camera, depth = truth.seen(view["idx"], height, width)
            cameras.append(camera)
            depths.append(depth)
        scale = truth.random.uniform(0.5, 2)
        maps = [
            truth.spoil(scale * local(c, z, cameras[0]))
            for c, z in zip(cameras, depths, strict=True)
        ]
        points, trust = zip(*[[torch.from_numpy(a)[None] for a in m] for m in maps], strict=True)
        truth.calls.append(("pair", one["idx"], two["idx"]))
        return {
            "view1": one, "view2": two, "loss": None,
            "pred1": {"pts3d": points[0], "conf": trust[0]},
            "pred2": {"pts3d_in_other_view": points[1], "conf": trust[1]},
        }  # fmt: skip

    module(monkeypatch, f"{top}.model", **{name: Stereo})
    module(monkeypatch, "dust3r.inference", inference=inference)


def fake_mast3r(monkeypatch, truth: Truth):
    fake_dust3r(monkeypatch, truth, "mast3r", "AsymmetricMASt3R")


def _similarity(truth: Truth) -> tuple[float, np.ndarray, np.ndarray]:
    """The model's world from the true one."""
    turn = Rotation.random(random_state=int(truth.random.integers(1 << 30))).as_matrix()
    return float(truth.random.uniform(0.5, 2)), turn, truth.random.normal(size=3)


def _world_answer(truth: Truth, index: int, height: int, width: int, motion, stretched=False):
    scale, turn, shift = motion
    camera, depth = truth.seen(index, height, width, stretched)
    near, confidence = truth.spoil(scale * local(camera, depth, camera))
    pose = np.eye(4)
    pose[:3, :3] = camera.rotation @ turn.T
    pose[:3, 3] = scale * camera.translation - pose[:3, :3] @ shift
    far = (near - pose[:3, 3]) @ pose[:3, :3]
    return camera, near, far.astype(np.float32), confidence, pose


def fake_must3r(monkeypatch, truth: Truth):
    def load_model(path, encoder=None, decoder=None, device="cuda", img_size=None,
                   memory_mode=None, verbose=True):  # fmt: skip
        truth.calls.append(("load_model", path, img_size))
        return "encoder", "decoder"

    def postprocess(pointmaps, pointmaps_activation=None, compute_cam=False):
        assert pointmaps_activation == "activation" and compute_cam
        return pointmaps

    def inference_multi_ar(encoder, decoder, imgs, img_ids, true_shape, mem_batches, verbose=False,
                           max_bs=None, to_render=None, encoder_precomputed_features=None,
                           precomputed_mem=None, preserve_gpu_mem=False,
                           post_process_function=None, device=None, return_mem=False,
                           viser_server=None, num_refinements_iterations=0):  # fmt: skip
        assert (encoder, decoder) == ("encoder", "decoder")
        assert torch.stack(true_shape).shape == (len(imgs), 2)
        assert sum(mem_batches) == len(imgs)
        motion = _similarity(truth)
        found = []
        for image, k, shape in zip(imgs, img_ids, true_shape, strict=True):
            assert list(image.shape[-2:]) == shape.tolist() and float(image.min()) < 0
            height, width = image.shape[-2:]
            _, near, far, trust, pose = _world_answer(truth, int(k), height, width, motion)
            arrays = {"pts3d": far, "pts3d_local": near, "conf": trust,
                      "c2w": np.linalg.inv(pose).astype(np.float32)}  # fmt: skip
            found.append(post_process_function({n: torch.from_numpy(a) for n, a in arrays.items()}))
        return found, found

    module(
        monkeypatch, "must3r.model", load_model=load_model,
        get_pointmaps_activation=lambda decoder, verbose=True: "activation",
    )  # fmt: skip
    module(
        monkeypatch, "must3r.engine.inference",
        inference_multi_ar=inference_multi_ar, postprocess=postprocess,
    )  # fmt: skip


def fake_vggt(monkeypatch, truth: Truth):
    class Vggt(Network):
        @classmethod
        def from_pretrained(cls, path):
            truth.calls.append(("from_pretrained", path))
            return cls()

        def load_state_dict(self, weights, strict=True):
            truth.calls.append(("load_state_dict", sorted(weights)))

        def __call__(self, images):
            count, channels, height, width = images.shape
            assert channels == 3 and width == 518 and height % 14 == 0
            assert float(images.min()) >= 0
            motion = _similarity(truth)
            answers = [_world_answer(truth, k, height, width, motion, True) for k in range(count)]
            code = [
                np.r_[pose[:3].ravel(), camera.fx, camera.fy] for camera, _, _, _, pose in answers
            ]
            return {
                "pose_enc": torch.from_numpy(np.stack(code).astype(np.float32))[None],
                "depth": torch.from_numpy(np.stack([a[1][..., 2:] for a in answers]))[None],
                "depth_conf": torch.from_numpy(np.stack([a[3] for a in answers]))[None],
            }

    def decode(pose_encoding, image_size_hw=None):
        height, width = image_size_hw
        extrinsic = pose_encoding[..., :12].reshape(*pose_encoding.shape[:2], 3, 4)
        intrinsic = torch.zeros(*pose_encoding.shape[:2], 3, 3)
        intrinsic[..., 0, 0], intrinsic[..., 1, 1] = pose_encoding[..., 12], pose_encoding[..., 13]
        intrinsic[..., 0, 2], intrinsic[..., 1, 2] = width / 2, height / 2
        intrinsic[..., 2, 2] = 1
        return extrinsic, intrinsic

    module(monkeypatch, "vggt.models.vggt", VGGT=Vggt)
    module(monkeypatch, "vggt.utils.pose_enc", pose_encoding_to_extri_intri=decode)


def fake_mapanything(monkeypatch, truth: Truth):
    class MapAnything(Network):
        @classmethod
        def from_pretrained(cls, path):
            truth.calls.append(("from_pretrained", path))
            return cls()

        def infer(self, views, memory_efficient_inference=False, use_amp=True, amp_dtype="bf16",
                  apply_mask=True, mask_edges=True, apply_confidence_mask=False,
                  confidence_percentile=10):  # fmt: skip
            assert not use_amp  # on the CPU
            motion = _similarity(truth)
            answers = []
            for k, view in enumerate(views):
                assert set(view) == {"img", "data_norm_type"}
                assert view["data_norm_type"] == ["dinov2"]
                height, width = view["img"].shape[-2:]
                _, near, far, trust, pose = _world_answer(truth, k, height, width, motion)
                mask = np.isfinite(near).all(-1)[..., None]
                arrays = {
                    "pts3d": np.nan_to_num(far), "pts3d_cam": np.nan_to_num(near), "conf": trust,
                    "mask": mask, "camera_poses": np.linalg.inv(pose).astype(np.float32),
                }  # fmt: skip
                answers.append({n: torch.from_numpy(a)[None] for n, a in arrays.items()})
            return answers

    module(monkeypatch, "mapanything.models", MapAnything=MapAnything)


FAKES = {
    "dust3r": fake_dust3r,
    "mast3r": fake_mast3r,
    "must3r": fake_must3r,
    "vggt": fake_vggt,
    "mapanything": fake_mapanything,
}
