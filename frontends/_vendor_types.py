# SPDX-License-Identifier: Apache-2.0
"""Definitions of makers' messages, for bags without definitions: of ROS 2 Humble and older, in sqlite3.

Versions of a driver differ. Of several definitions the longest comes first, since only bytes left over show a wrong
one. Behind the last field that is read, a definition may be up to three bytes shorter than the message.
"""

from __future__ import annotations

_LINE = "=" * 80
_HEADER = "std_msgs/Header header"


def _definition(fields: str, **parts: str) -> str:
    """Return a definition as bags hold it.

    Args:
        fields: separated by semicolons. parts: definitions of further types, by package and name joined by two
            underscores.
    """
    said = [fields, *(f"{_LINE}\nMSG: {name.replace('__', '/')}\n{part}" for name, part in parts.items())]
    return "\n".join(text.replace("; ", "\n") for text in said) + "\n"


def _flags(names: str) -> str:
    return "; ".join(f"bool {name}" for name in names.split())


_SBG_IMU = _flags(
    "imu_com imu_status imu_accel_x imu_accel_y imu_accel_z imu_gyro_x imu_gyro_y imu_gyro_z imu_accels_in_range imu_gyros_in_range "
    "imu_gyros_use_high_scale"  # not in all versions; the alignment of what follows allows it to be missing
)
_SBG_SIGNALS = "gps_l1_used gps_l2_used gps_l5_used glo_l1_used glo_l2_used"
_SBG_MORE_SIGNALS = (
    f"{_SBG_SIGNALS} glo_l3_used gal_e1_used gal_e5a_used gal_e5b_used gal_e5alt_used gal_e6_used bds_b1_used bds_b2_used "
    "bds_b3_used qzss_l1_used qzss_l2_used qzss_l5_used"
)
_SBG_WATCH = "uint8 ifm; uint8 spoofing; uint8 osnma; "
_SBG_FIX = "uint8 status; uint8 type; "


def _sbg_place(status: str) -> str:
    return _definition(
        f"{_HEADER}; uint32 time_stamp; SbgGpsPosStatus status; uint32 gps_tow; float64 latitude; float64 longitude; float64 altitude; "
        "float32 undulation; geometry_msgs/Vector3 position_accuracy; uint8 num_sv_tracked; uint8 num_sv_used; uint16 base_station_id; "
        "uint16 diff_age",
        sbg_driver__SbgGpsPosStatus=status,
    )


_SBG_HEADING = (
    f"{_HEADER}; uint32 time_stamp; uint16 status; uint32 tow; float32 true_heading; float32 true_heading_acc; float32 pitch; "
    "float32 pitch_acc"
)

_SBG_FILTER = f"uint8 solution_mode; {_flags('attitude_valid heading_valid velocity_valid position_valid')}"
_SBG_USED = (
    "vert_ref_used mag_ref_used gps1_vel_used gps1_pos_used gps1_hdt_used gps2_vel_used gps2_pos_used gps2_hdt_used odo_used "
    "dvl_bt_used dvl_wt_used user_pos_used user_vel_used user_heading_used usbl_used air_data_used zupt_used align_valid depth_used"
)
# Versions differ in how many sensors they name.
_SBG_FILTERS = tuple(f"{_SBG_FILTER}; {_flags(' '.join(_SBG_USED.split()[:count]))}" for count in (19, 11))

_UBX_PVT = (
    "uint32 i_tow; uint16 year; uint8 month; uint8 day; uint8 hour; uint8 min; uint8 sec; uint8 valid; uint32 t_acc; int32 nano; "
    "uint8 fix_type; uint8 flags; uint8 flags2; uint8 num_sv; int32 lon; int32 lat; int32 height; int32 h_msl; uint32 h_acc; "
    "uint32 v_acc; int32 vel_n; int32 vel_e; int32 vel_d; int32 g_speed; int32 heading; uint32 s_acc; uint32 head_acc; uint16 p_dop; "
    "uint8[6] reserved1"
)

_OEM7 = {
    "novatel_oem7_msgs__Oem7Header": (
        "string message_name; uint16 message_id; uint8 message_type; uint32 sequence_number; uint8 time_status; uint16 gps_week_number; "
        "uint32 gps_week_milliseconds; uint8 idle_time"
    ),
    "novatel_oem7_msgs__SolutionStatus": "uint32 status",
    "novatel_oem7_msgs__PositionOrVelocityType": "uint32 type",
    "novatel_oem7_msgs__BestExtendedSolutionStatus": "uint8 status",
    "novatel_oem7_msgs__SolutionSource": "uint8 source",
}
_OEM7_SOLUTION = f"{_HEADER}; Oem7Header nov_header; SolutionStatus sol_status; PositionOrVelocityType "
_OEM7_PLACE = _definition(
    f"{_OEM7_SOLUTION}pos_type; float64 lat; float64 lon; float64 hgt; float32 undulation; uint32 datum_id; float32 lat_stdev; "
    "float32 lon_stdev; float32 hgt_stdev; int8[4] stn_id; float32 diff_age; float32 sol_age; uint8 num_svs; uint8 num_sol_svs; "
    "uint8 num_sol_l1_svs; uint8 num_sol_multi_svs; uint8 reserved; BestExtendedSolutionStatus ext_sol_stat; "
    "uint8 galileo_beidou_sig_mask; uint8 gps_glonass_sig_mask",
    **_OEM7,
)
_OEM7_VELOCITY = _definition(
    f"{_OEM7_SOLUTION}vel_type; float32 latency; float32 diff_age; float64 hor_speed; float64 trk_gnd; float64 ver_speed; "
    "float32 reserved",
    **_OEM7,
)

_OEM7_INS = (
    "float64 north_velocity; float64 east_velocity; float64 up_velocity; float64 roll; float64 pitch; float64 azimuth; "
)
_OEM7_SETTLED = {"novatel_oem7_msgs__InertialSolutionStatus": "uint32 status"}

# `novatel_gps_msgs`; names of flags are not all those of its versions.
_NOVATEL_STATE = _flags(
    "error_flag temperature_flag voltage_supply_flag antenna_powered antenna_is_open antenna_is_shorted cpu_overload_flag com1_buffer_overrun "
    "com2_buffer_overrun com3_buffer_overrun usb_buffer_overrun rf1_agc_flag rf2_agc_flag almanac_flag position_solution_flag "
    "position_fixed_flag clock_steering_status_enabled clock_model_flag oemv_external_oscillator_flag software_resource_flag "
    "aux1_status_event_flag aux2_status_event_flag aux3_status_event_flag"
)
_NOVATEL_START = f"{_HEADER}; NovatelMessageHeader novatel_msg_header; "
_NOVATEL = {
    "novatel_gps_msgs__NovatelMessageHeader": (
        "string message_name; string port; uint32 sequence_num; float32 percent_idle_time; string gps_time_status; uint32 gps_week_num; "
        "float64 gps_seconds; NovatelReceiverStatus receiver_status; uint32 receiver_software_version"
    ),
    "novatel_gps_msgs__NovatelReceiverStatus": f"uint32 original_status_code; {_NOVATEL_STATE}",
}
_NOVATEL_EXTENDED = {
    "novatel_gps_msgs__NovatelExtendedSolutionStatus": (
        "uint32 original_mask; bool advance_rtk_verified; string psueorange_iono_correction"
    )
}
_NOVATEL_SIGNALS = {
    "novatel_gps_msgs__NovatelSignalMask": (
        "uint32 original_mask; bool gps_l1_used_in_solution; bool gps_l2_used_in_solution; bool gps_l3_used_in_solution; "
        "bool glonass_l1_used_in_solution; bool glonass_l2_used_in_solution"
    )
}
_NOVATEL_INS = {
    "novatel_gps_msgs__NovatelInsExtendedSolutionStatus": (
        "uint32 original_mask; "
        + _flags(
            "position_update phase_update zero_velocity_update wheel_sensor_update align_update external_position_update doppler_update "
            "pseudorange_update velocity_update dead_reckoning_update phase_wind_up_update course_over_ground_update "
            "external_velocity_update external_attitude_update ins_solution_converged secondary_ins_solution_used "
            "turn_on_biases_estimated alignment_direction_verified"
        )
        + "; string alignment_type; string nvm_seed_status"
    )
}

_SBF = {
    "septentrio_gnss_driver__BlockHeader": (
        "uint8 sync_1; uint8 sync_2; uint16 crc; uint16 id; uint8 revision; uint16 length; uint32 tow; uint16 wnc"
    )
}

_PX4_ACCURACY = (
    "float32 s_variance_m_s; float32 c_variance_rad; uint8 fix_type; float32 eph; float32 epv; float32 hdop; float32 vdop; "
    "int32 noise_per_ms; uint16 automatic_gain_control; uint8 jamming_state; int32 jamming_indicator"
)
_PX4_START = "uint64 timestamp; uint64 timestamp_sample; uint32 device_id"
_PX4_DEGREES = "float64 latitude_deg; float64 longitude_deg; float64 altitude_msl_m; float64 altitude_ellipsoid_m"
_PX4_INTEGERS = "int32 lat; int32 lon; int32 alt; int32 alt_ellipsoid"
_PX4_VELOCITY = (
    "float32 vel_m_s; float32 vel_n_m_s; float32 vel_e_m_s; float32 vel_d_m_s; float32 cog_rad; bool vel_ned_valid; "
    "int32 timestamp_time_relative; uint64 time_utc_usec; uint8 satellites_used"
)
_PX4_HEADING = "float32 heading; float32 heading_offset; float32 heading_accuracy; float32 rtcm_injection_rate; uint8 selected_rtcm_instance"
_PX4_RTCM = "bool rtcm_crc_failed; uint8 rtcm_msg_used"
_PX4_QUALITY = (
    "uint8 quality_corrections; uint8 quality_receiver; uint8 quality_gnss_signals; uint8 quality_post_processing"
)
_PX4_AUTHENTIC = f"uint8 spoofing_state; uint8 authentication_state; {_PX4_VELOCITY}; uint32 system_error"

_GEO_POINT = "float64 latitude; float64 longitude; float64 altitude"
_GEO_POSE = {
    "geographic_msgs__GeoPose": "GeoPoint position; geometry_msgs/Quaternion orientation",
    "geographic_msgs__GeoPoint": _GEO_POINT,
}

_WATERLINKED_BEAM = "int64 id; float64 velocity; float64 distance; float64 rssi; float64 nsd; bool valid"
_WATERLINKED = f"{_HEADER}; float64 time; geometry_msgs/Vector3 velocity; float64 fom; "
_WATERLINKED_BEAMS = "float64 altitude; DVLBeam[] beams; bool velocity_valid; int64 status; "
_DVL = (
    f"{_HEADER}; uint8 velocity_mode; uint8 dvl_type; geometry_msgs/Vector3 velocity; float64[9] velocity_covar; float64 altitude; "
    "float64 course_gnd; float64 speed_gnd; uint8 num_good_beams; float32 sound_speed; bool beam_ranges_valid; bool beam_velocities_valid; "
    "geometry_msgs/Vector3[4] beam_unit_vec; float64[4] range; float32[4] range_covar; float32[4] beam_quality; float32[4] beam_velocity; "
    "float32[4] beam_velocity_covar"
)


def _waterlinked(package: str, fields: str) -> str:
    return _definition(fields, **{f"{package}__DVLBeam": _WATERLINKED_BEAM})


VENDOR_TYPES: dict[str, tuple[str, ...]] = {
    "sbg_driver/msg/SbgImuData": (
        _definition(
            f"{_HEADER}; uint32 time_stamp; SbgImuStatus imu_status; geometry_msgs/Vector3 accel; geometry_msgs/Vector3 gyro; float32 temp; "
            "geometry_msgs/Vector3 delta_vel; geometry_msgs/Vector3 delta_angle",
            sbg_driver__SbgImuStatus=_SBG_IMU,
        ),
    ),
    "sbg_driver/msg/SbgImuShort": (
        _definition(
            f"{_HEADER}; uint32 time_stamp; SbgImuStatus imu_status; geometry_msgs/Vector3 delta_velocity; geometry_msgs/Vector3 delta_angle; "
            "int16 temperature",
            sbg_driver__SbgImuStatus=_SBG_IMU,
        ),
    ),
    "sbg_driver/msg/SbgGpsPos": tuple(
        _sbg_place(_SBG_FIX + status)
        for status in (_SBG_WATCH + _flags(_SBG_MORE_SIGNALS), _SBG_WATCH + _flags(_SBG_SIGNALS), _flags(_SBG_SIGNALS))
    ),
    "sbg_driver/msg/SbgGpsVel": (
        _definition(
            f"{_HEADER}; uint32 time_stamp; SbgGpsVelStatus status; uint32 gps_tow; geometry_msgs/Vector3 vel; geometry_msgs/Vector3 vel_acc; "
            "float32 course; float32 course_acc",
            sbg_driver__SbgGpsVelStatus="uint8 vel_status; uint8 vel_type",
        ),
    ),
    "sbg_driver/msg/SbgGpsHdt": (
        _definition(f"{_SBG_HEADING}; float32 baseline; uint8 num_sv_tracked; uint8 num_sv_used"),
        _definition(f"{_SBG_HEADING}; float32 baseline"),
        _definition(_SBG_HEADING),
    ),
    "sbg_driver/msg/SbgEkfNav": tuple(
        _definition(
            f"{_HEADER}; uint32 time_stamp; geometry_msgs/Vector3 velocity; geometry_msgs/Vector3 velocity_accuracy; float64 latitude; "
            "float64 longitude; float64 altitude; float32 undulation; geometry_msgs/Vector3 position_accuracy; SbgEkfStatus status",
            sbg_driver__SbgEkfStatus=status,
        )
        for status in _SBG_FILTERS
    ),
    **{
        f"sbg_driver/msg/{name}": tuple(
            _definition(
                f"{_HEADER}; uint32 time_stamp; geometry_msgs/{turned}; geometry_msgs/Vector3 accuracy; SbgEkfStatus status",
                sbg_driver__SbgEkfStatus=status,
            )
            for status in _SBG_FILTERS
        )
        for name, turned in (("SbgEkfEuler", "Vector3 angle"), ("SbgEkfQuat", "Quaternion quaternion"))
    },
    "ublox_msgs/msg/NavPVT": (_definition(f"{_UBX_PVT}; int32 head_veh; int16 mag_dec; uint16 mag_acc"),),
    "ublox_msgs/msg/NavPVT7": (_definition(_UBX_PVT),),
    "ublox_msgs/msg/NavRELPOSNED9": (
        _definition(
            "uint8 version; uint8 reserved1; uint16 ref_station_id; uint32 i_tow; int32 rel_pos_n; int32 rel_pos_e; int32 rel_pos_d; "
            "int32 rel_pos_length; int32 rel_pos_heading; uint8[4] reserved2; int8 rel_pos_hpn; int8 rel_pos_hpe; int8 rel_pos_hpd; "
            "int8 rel_pos_hp_length; uint32 acc_n; uint32 acc_e; uint32 acc_d; uint32 acc_length; uint32 acc_heading; "
            "uint8[4] reserved3; uint32 flags"
        ),
    ),
    "ublox_ubx_msgs/msg/UBXNavPVT": (
        _definition(
            f"{_HEADER}; uint32 itow; uint16 year; uint8 month; uint8 day; uint8 hour; uint8 min; uint8 sec; "
            f"{_flags('valid_date valid_time fully_resolved valid_mag')}; uint32 t_acc; int32 nano; GpsFix gps_fix; bool gnss_fix_ok; "
            f"bool diff_soln; PSMPVT psm; bool head_veh_valid; CarrSoln carr_soln; {_flags('confirmed_avail confirmed_date confirmed_time')}; "
            "uint8 num_sv; int32 lon; int32 lat; int32 height; int32 hmsl; uint32 h_acc; uint32 v_acc; int32 vel_n; int32 vel_e; int32 vel_d; "
            "int32 g_speed; int32 head_mot; uint32 s_acc; uint32 head_acc; uint16 p_dop; bool invalid_llh; int32 head_veh; int16 mag_dec; "
            "uint16 mag_acc",
            ublox_ubx_msgs__GpsFix="uint8 fix_type", ublox_ubx_msgs__PSMPVT="uint8 state", ublox_ubx_msgs__CarrSoln="uint8 status",
        ),
    ),
    "ublox_ubx_msgs/msg/UBXNavRelPosNED": (
        _definition(
            f"{_HEADER}; uint8 version; uint16 ref_station_id; uint32 itow; int32 rel_pos_n; int32 rel_pos_e; int32 rel_pos_d; "
            "int32 rel_pos_length; int32 rel_pos_heading; int8 rel_pos_hp_n; int8 rel_pos_hp_e; int8 rel_pos_hp_d; int8 rel_pos_hp_length; "
            f"uint32 acc_n; uint32 acc_e; uint32 acc_d; uint32 acc_length; uint32 acc_heading; {_flags('gnss_fix_ok diff_soln rel_pos_valid')}; "
            f"CarrSoln carr_soln; {_flags('is_moving ref_pos_miss ref_obs_miss rel_pos_heading_valid rel_pos_normalized')}",
            ublox_ubx_msgs__CarrSoln="uint8 status",
        ),
    ),
    **dict.fromkeys(("novatel_oem7_msgs/msg/BESTPOS", "novatel_oem7_msgs/msg/BESTGNSSPOS"), (_OEM7_PLACE,)),
    **dict.fromkeys(("novatel_oem7_msgs/msg/BESTVEL", "novatel_oem7_msgs/msg/BESTGNSSVEL"), (_OEM7_VELOCITY,)),
    "novatel_oem7_msgs/msg/HEADING2": (
        _definition(
            f"{_OEM7_SOLUTION}pos_type; float32 length; float32 heading; float32 pitch; float32 reserved; float32 heading_stdev; "
            "float32 pitch_stdev; int8[4] rover_stn_id; int8[4] master_stn_id; uint8 num_sv_tracked; uint8 num_sv_in_sol; "
            "uint8 num_sv_obs; uint8 num_sv_multi; SolutionSource sol_source; BestExtendedSolutionStatus ext_sol_status; "
            "uint8 galileo_beidou_sig_mask; uint8 gps_glonass_sig_mask",
            **_OEM7,
        ),
    ),
    "novatel_oem7_msgs/msg/INSPVAX": (
        _definition(
            f"{_HEADER}; Oem7Header nov_header; InertialSolutionStatus ins_status; PositionOrVelocityType pos_type; float64 latitude; "
            f"float64 longitude; float64 height; float32 undulation; {_OEM7_INS}float32 latitude_stdev; float32 longitude_stdev; "
            "float32 height_stdev; float32 north_velocity_stdev; float32 east_velocity_stdev; float32 up_velocity_stdev; float32 roll_stdev; "
            "float32 pitch_stdev; float32 azimuth_stdev; INSExtendedSolutionStatus ext_sol_status; uint16 time_since_update",
            novatel_oem7_msgs__INSExtendedSolutionStatus="uint32 status", **_OEM7, **_OEM7_SETTLED,
        ),
    ),
    "novatel_oem7_msgs/msg/INSPVA": (
        _definition(
            f"{_HEADER}; Oem7Header nov_header; float64 latitude; float64 longitude; float64 height; {_OEM7_INS}InertialSolutionStatus status",
            **_OEM7, **_OEM7_SETTLED,
        ),
    ),
    **dict.fromkeys(
        ("gnss_comm/msg/GnssPVTSolnMsg", "gnss_comm_msgs/msg/GnssPVTSolnMsg"),
        (
            _definition(
                "GnssTimeMsg time; uint8 fix_type; bool valid_fix; bool diff_soln; uint8 carr_soln; uint8 num_sv; float64 latitude; "
                "float64 longitude; float64 altitude; float64 height_msl; float64 h_acc; float64 v_acc; float64 p_dop; float64 vel_n; "
                "float64 vel_e; float64 vel_d; float64 vel_acc",
                **dict.fromkeys(("gnss_comm__GnssTimeMsg", "gnss_comm_msgs__GnssTimeMsg"), "uint32 week; float64 tow"),
            ),
        ),
    ),
    "novatel_gps_msgs/msg/NovatelPosition": (
        _definition(
            f"{_NOVATEL_START}string solution_status; string position_type; float64 lat; float64 lon; float64 height; float32 undulation; "
            "string datum_id; float32 lat_sigma; float32 lon_sigma; float32 height_sigma; string base_station_id; float32 diff_age; "
            "float32 solution_age; uint8 num_satellites_tracked; uint8 num_satellites_used_in_solution; "
            "uint8 num_gps_and_glonass_l1_used_in_solution; uint8 num_gps_and_glonass_l1_and_l2_used_in_solution; "
            "NovatelExtendedSolutionStatus extended_solution_status; NovatelSignalMask signal_mask",
            **_NOVATEL, **_NOVATEL_EXTENDED, **_NOVATEL_SIGNALS,
        ),
    ),
    "novatel_gps_msgs/msg/NovatelVelocity": (
        _definition(
            f"{_NOVATEL_START}string solution_status; string velocity_type; float32 latency; float32 age; float64 horizontal_speed; "
            "float64 track_ground; float64 vertical_speed",
            **_NOVATEL,
        ),
    ),
    "novatel_gps_msgs/msg/NovatelHeading2": (
        _definition(
            f"{_NOVATEL_START}string solution_status; string position_type; float32 baseline_length; float32 heading; float32 pitch; "
            "float32 heading_sigma; float32 pitch_sigma; string rover_station_id; string master_station_id; uint8 num_satellites_tracked; "
            "uint8 num_satellites_used_in_solution; uint8 num_satellites_above_elevation_mask_angle; "
            "uint8 num_satellites_above_elevation_mask_angle_l2; uint8 solution_source; "
            "NovatelExtendedSolutionStatus extended_solution_status; NovatelSignalMask signal_mask",
            **_NOVATEL, **_NOVATEL_EXTENDED, **_NOVATEL_SIGNALS,
        ),
    ),
    "novatel_gps_msgs/msg/Inspvax": tuple(
        _definition(
            f"{_NOVATEL_START}string ins_status; string position_type; float64 latitude; float64 longitude; float64 altitude; "
            f"float32 undulation; {_OEM7_INS}float32 latitude_std; float32 longitude_std; float32 altitude_std; float32 north_velocity_std; "
            "float32 east_velocity_std; float32 up_velocity_std; float32 roll_std; float32 pitch_std; float32 azimuth_std; "
            f"{next(iter(extended)).partition('__')[2]} extended_status; uint16 seconds_since_update",
            **_NOVATEL, **extended,
        )
        for extended in (_NOVATEL_INS, _NOVATEL_EXTENDED)
    ),
    "novatel_gps_msgs/msg/Inspva": (
        _definition(
            f"{_NOVATEL_START}uint32 week; float64 seconds; float64 latitude; float64 longitude; float64 height; {_OEM7_INS}string status",
            **_NOVATEL,
        ),
    ),
    "septentrio_gnss_driver/msg/INSNavGeod": (
        _definition(
            f"{_HEADER}; BlockHeader block_header; uint8 gnss_mode; uint8 error; uint16 info; uint16 gnss_age; float64 latitude; "
            "float64 longitude; float64 height; float32 undulation; uint16 accuracy; uint16 latency; uint8 datum; uint16 sb_list; "
            "float32 latitude_std_dev; float32 longitude_std_dev; float32 height_std_dev; float32 latitude_longitude_cov; "
            "float32 latitude_height_cov; float32 longitude_height_cov; float32 heading; float32 pitch; float32 roll; "
            "float32 heading_std_dev; float32 pitch_std_dev; float32 roll_std_dev; float32 heading_pitch_cov; float32 heading_roll_cov; "
            "float32 pitch_roll_cov; float32 ve; float32 vn; float32 vu; float32 ve_std_dev; float32 vn_std_dev; float32 vu_std_dev; "
            "float32 ve_vn_cov; float32 ve_vu_cov; float32 vn_vu_cov",
            **_SBF,
        ),
    ),
    "septentrio_gnss_driver/msg/PVTGeodetic": (
        _definition(
            f"{_HEADER}; BlockHeader block_header; uint8 mode; uint8 error; float64 latitude; float64 longitude; float64 height; "
            "float32 undulation; float32 vn; float32 ve; float32 vu; float32 cog; float64 rx_clk_bias; float32 rx_clk_drift; "
            "uint8 time_system; uint8 datum; uint8 nr_sv; uint8 wa_corr_info; uint16 reference_id; uint16 mean_corr_age; "
            "uint32 signal_info; uint8 alert_flag; uint8 nr_bases; uint16 ppp_info; uint16 latency; uint16 h_accuracy; "
            "uint16 v_accuracy; uint8 misc",
            **_SBF,
        ),
    ),
    "septentrio_gnss_driver/msg/AttEuler": (
        _definition(
            f"{_HEADER}; BlockHeader block_header; uint8 nr_sv; uint8 error; uint16 mode; float32 heading; float32 pitch; float32 roll; "
            "float32 pitch_dot; float32 roll_dot; float32 heading_dot",
            **_SBF,
        ),
    ),
    # In PX4 1.14 three bytes more, in some later ones nine; the last fields are not read.
    "px4_msgs/msg/SensorCombined": tuple(
        _definition(
            "uint64 timestamp; float32[3] gyro_rad; uint32 gyro_integral_dt; int32 accelerometer_timestamp_relative; "
            f"float32[3] accelerometer_m_s2; uint32 accelerometer_integral_dt; uint8 accelerometer_clipping{more}"
        )
        for more in ("; uint8[9] more", "")
    ),
    # PX4 1.17, 1.16, 1.14 and 1.15, 1.13.
    "px4_msgs/msg/SensorGps": tuple(
        _definition("; ".join((_PX4_START, *parts)))
        for parts in (
            (_PX4_DEGREES, _PX4_ACCURACY, _PX4_AUTHENTIC, _PX4_HEADING, _PX4_RTCM, _PX4_QUALITY),
            (_PX4_DEGREES, _PX4_ACCURACY, _PX4_AUTHENTIC, _PX4_HEADING, _PX4_RTCM),
            (_PX4_DEGREES, _PX4_ACCURACY, "uint8 spoofing_state", _PX4_VELOCITY, _PX4_HEADING, _PX4_RTCM),
            (_PX4_INTEGERS, _PX4_ACCURACY, "uint8 spoofing_state", _PX4_VELOCITY, _PX4_HEADING),
        )
    ),
    "px4_msgs/msg/VehicleGpsPosition": (
        _definition(f"{_PX4_START}; {_PX4_INTEGERS}; {_PX4_ACCURACY}; {_PX4_VELOCITY}; {_PX4_HEADING}"),
    ),
    "dvl_msgs/msg/DVL": tuple(
        _waterlinked("dvl_msgs", fields)
        for fields in (
            f"{_WATERLINKED}float64[] covariance; {_WATERLINKED_BEAMS}int64 time_of_validity; int64 time_of_transmission; string form",
            f"{_WATERLINKED}{_WATERLINKED_BEAMS}string form",
        )
    ),
    "geographic_msgs/msg/GeoPointStamped": (_definition(f"{_HEADER}; GeoPoint position", geographic_msgs__GeoPoint=_GEO_POINT),),
    "geographic_msgs/msg/GeoPoseStamped": (_definition(f"{_HEADER}; GeoPose pose", **_GEO_POSE),),
    "geographic_msgs/msg/GeoPoseWithCovarianceStamped": (
        _definition(
            f"{_HEADER}; GeoPoseWithCovariance pose", **_GEO_POSE, geographic_msgs__GeoPoseWithCovariance="GeoPose pose; float64[36] covariance",
        ),
    ),
    "waterlinked_a50_ros_driver/msg/DVL": (
        _waterlinked("waterlinked_a50_ros_driver", f"{_WATERLINKED}{_WATERLINKED_BEAMS}string form"),
    ),
    **dict.fromkeys(("marine_acoustic_msgs/msg/Dvl", "acoustic_msgs/msg/Dvl"), (_definition(_DVL),)),
}  # fmt: skip
