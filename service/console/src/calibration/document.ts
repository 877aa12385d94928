// calibration.json as the engine writes it.
export interface Pose {
  rotation_xyzw: number[];
  translation_m: number[];
}
export interface CameraCalibration {
  model: string;
  width: number;
  height: number;
  param_names: string[];
  given: { rig_from_cam: Pose; params: number[] };
  refined: { rig_from_cam: Pose; params: number[]; time_offset_us?: number };
  difference: { rotation_vector_deg: number[]; rotation_deg: number; translation_m: number[]; focal_px: number };
  sigma?: { rotation_deg?: (number | null)[]; translation_m?: (number | null)[]; time_offset_us?: number };
  repeatability?: { rotation_deg?: (number | null)[]; translation_m?: (number | null)[] }; // of cameras that varied, with lenses held
  observed?: { rotation: boolean[]; translation: boolean[] };
  verdict?: { rotation: string[]; translation: string[]; time_offset?: string };
  wrong: boolean;
}
export interface Calibration {
  adjusted?: boolean;
  why?: string;
  cameras: Record<string, CameraCalibration>;
}
export const AXES = ["x", "y", "z"] as const;
