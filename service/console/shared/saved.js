// What an export or a backup of a map holds, and what it does not: said where backups are made and maps are deleted.

export const SAVED = "its settings, calibration, places with their looks and pictures, traverses, cameras, and labelled frames are saved";
export const NOT_SAVED = "Not saved are frames for review without a label, with what runs proposed, and what was counted and measured: answers, histories, alarms, what runs said of the calibration, and its latest measurement.";
