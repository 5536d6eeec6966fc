"""The parameters of a stream, named and defaulted as in the specification (section 1)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields


@dataclass(frozen=True)
class Params:
    """Section [ratslam] of an OpenRatSLAM configuration."""

    pc_dim_xy: int = 21
    pc_dim_th: int = 36
    pc_w_e_dim: int = 7
    pc_w_i_dim: int = 5
    pc_w_e_var: int = 1  # a standard deviation, in spite of its name
    pc_w_i_var: int = 2
    pc_global_inhib: float = 2e-5
    pc_cell_x_size: float = 1.0
    pc_vt_inject_energy: float = 0.15
    pc_vt_restore: float = 0.05
    vt_active_decay: float = 1.0
    exp_delta_pc_threshold: float = 2.0
    template_x_size: int = 1
    template_y_size: int = 1
    vt_shift_match: int = 25
    vt_step_match: int = 5
    vt_match_threshold: float = 0.03
    vt_normalisation: float = 0.0
    vt_patch_normalise: int = 0
    vt_min_patch_normalisation_std: float = 0.0
    vt_panoramic: int = 0
    image_crop_x_min: int = 0
    image_crop_y_min: int = 0
    image_crop_x_max: int = -1
    image_crop_y_max: int = -1
    exp_correction: float = 0.5
    exp_loops: int = 10
    exp_initial_em_deg: float = 90.0

    def __post_init__(self) -> None:
        if self.pc_w_e_dim % 2 == 0 or self.pc_w_i_dim % 2 == 0:
            raise ValueError("pc_w_e_dim and pc_w_i_dim must be odd")

    @staticmethod
    def parse(texts: Mapping[str, str]) -> Params:
        """Values as strings; a missing one takes its default, a strange one is left alone."""
        read = {"int": int, "float": float}
        return Params(**{f.name: read[str(f.type)](texts[f.name]) for f in fields(Params) if f.name in texts})
