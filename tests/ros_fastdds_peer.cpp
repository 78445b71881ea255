// A peer on Fast DDS, with types that fastddsgen has made of the standard definitions.
// Says what it hears of pressures and tip, and sends a point and a trajectory of these pressures.
#include "rosPubSubTypes.h"

#include <chrono>
#include <cstdlib>
#include <fastdds/dds/domain/DomainParticipant.hpp>
#include <fastdds/dds/domain/DomainParticipantFactory.hpp>
#include <fastdds/dds/publisher/DataWriter.hpp>
#include <fastdds/dds/publisher/Publisher.hpp>
#include <fastdds/dds/subscriber/DataReader.hpp>
#include <fastdds/dds/subscriber/SampleInfo.hpp>
#include <fastdds/dds/subscriber/Subscriber.hpp>
#include <fastdds/rtps/transport/UDPv4TransportDescriptor.h>
#include <iostream>
#include <thread>

using namespace eprosima::fastdds::dds;

template <typename Support>
static Topic *topic(DomainParticipant *participant, const char *name)
{
    TypeSupport type(new Support());
    type.register_type(participant);
    return participant->create_topic(name, type.get_type_name(), TOPIC_QOS_DEFAULT);
}

int main(int, char **arguments)
{
    DomainParticipantQos qos;
    qos.transport().use_builtin_transports = false;
    auto loopback = std::make_shared<eprosima::fastdds::rtps::UDPv4TransportDescriptor>();
    loopback->interfaceWhiteList.push_back("127.0.0.1");
    qos.transport().user_transports.push_back(loopback);
    auto participant =
        DomainParticipantFactory::get_instance()->create_participant(std::atoi(arguments[1]), qos);
    auto pressures = topic<sensor_msgs::msg::JointStatePubSubType>(participant, "rt/stiffopt/pressure");
    auto tips = topic<geometry_msgs::msg::PoseStampedPubSubType>(participant, "rt/stiffopt/tip");
    auto points =
        topic<geometry_msgs::msg::PointStampedPubSubType>(participant, "rt/stiffopt/set_target_point");
    auto trajectories =
        topic<trajectory_msgs::msg::JointTrajectoryPubSubType>(participant, "rt/stiffopt/follow_trajectory");
    auto subscriber = participant->create_subscriber(SUBSCRIBER_QOS_DEFAULT);
    auto publisher = participant->create_publisher(PUBLISHER_QOS_DEFAULT);
    DataReaderQos reliable = DATAREADER_QOS_DEFAULT;
    reliable.reliability().kind = RELIABLE_RELIABILITY_QOS;
    auto pressure_reader = subscriber->create_datareader(pressures, reliable);
    auto tip_reader = subscriber->create_datareader(tips, DATAREADER_QOS_DEFAULT);
    auto point_writer = publisher->create_datawriter(points, DATAWRITER_QOS_DEFAULT);
    auto trajectory_writer = publisher->create_datawriter(trajectories, DATAWRITER_QOS_DEFAULT);

    sensor_msgs::msg::JointState heard;
    geometry_msgs::msg::PoseStamped tip;
    SampleInfo info;
    bool has_heard = false, has_tip = false, sent = false;
    for (int k = 0; k < 6000; ++k) { // a minute, or until it is killed
        std::this_thread::sleep_for(std::chrono::milliseconds(10));
        while (pressure_reader->take_next_sample(&heard, &info) == ReturnCode_t::RETCODE_OK) {
            if (!info.valid_data || has_heard) continue;
            has_heard = true;
            std::cout << "pressure " << heard.header().frame_id();
            for (size_t i = 0; i < heard.name().size(); ++i)
                std::cout << " " << heard.name()[i] << "=" << heard.position()[i];
            std::cout << std::endl;
        }
        while (tip_reader->take_next_sample(&tip, &info) == ReturnCode_t::RETCODE_OK) {
            if (!info.valid_data || has_tip) continue;
            has_tip = true;
            auto &p = tip.pose().position();
            std::cout << "tip " << p.x() << " " << p.y() << " " << p.z() << " "
                      << tip.pose().orientation().w() << std::endl;
        }
        PublicationMatchedStatus point_match, trajectory_match;
        point_writer->get_publication_matched_status(point_match);
        trajectory_writer->get_publication_matched_status(trajectory_match);
        bool matched = point_match.current_count && trajectory_match.current_count;
        if (!sent && has_heard && has_tip && matched && k > 20) {
            sent = true;
            geometry_msgs::msg::PointStamped point;
            point.header().frame_id("base");
            point.point().x(0.01);
            point.point().y(-0.02);
            point.point().z(0.19);
            point_writer->write(&point);
            trajectory_msgs::msg::JointTrajectory trajectory;
            trajectory.joint_names(heard.name());
            for (int seconds = 1; seconds < 3; ++seconds) {
                trajectory_msgs::msg::JointTrajectoryPoint each;
                for (size_t i = 0; i < heard.name().size(); ++i)
                    each.positions().push_back(1e3 * seconds * double(i + 1));
                each.time_from_start().sec(seconds);
                trajectory.points().push_back(each);
            }
            trajectory_writer->write(&trajectory);
            std::cout << "sent" << std::endl;
        }
    }
}
